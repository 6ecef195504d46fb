// One robot that a visitor drives: it walks, jumps on request, and walks again. Policy steps last 1/60 s.
export const DT = 1 / 60; // [s]
const SLEW = 1.25 * DT; // [m/s], [rad/s] change of a commanded velocity in a policy step
const SQUAT = 30; // policy steps from the handover to the jump's command
const [STANCE, FLIGHT, LANDED] = [0, 1, 2];
const [TURNING, WALKING] = [2, 1.5]; // [1/s] gains of the approach: yaw rate over bearing, speed over distance
const BEARING = 0.06; // [rad] largest bearing of a goal from which the robot jumps
const BIAS = 1e-3; // [m/s] of the sideways velocity while it walks: an exactly symmetric robot does not alternate its legs
const FALL_TIME = 2.5; // [s] from a fall to the reset
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

// Return the smallest and largest distance [m] of a jump from where the robot stands; the training's range is larger.
export function reach(policy) {
  const [low, high] = policy.range["distance ahead"];
  const nearest = Math.max(low, 0.15);
  return [nearest, nearest + 0.7 * (high - nearest)];
}

export class Session {
  // policies: by skill, walk, jump_up and jump_to; changed: called with the outcome of each jump.
  constructor(robot, policies, finished = () => {}) {
    this.robot = robot;
    this.policies = policies;
    this.finished = finished;
    this.drag = null; // place [m] to which the visitor pulls the robot
    this.velocity = [0, 0, 0]; // commanded by the visitor: ahead, left [m/s], about z [rad/s]
    this.reset();
  }

  reset() {
    this.robot.reset();
    this.skill = "walk";
    this.command = [0, 0, 0];
    this.jump = null;
    this.request = null; // the jump that the visitor wants: height [m] or goal [m]
    this.fallen = false;
    this.pushSteps = 0;
    this.policies.walk.reset();
  }

  jumpUp(height) { this.want({ skill: "jump_up", height }); }

  jumpTo(goal) { this.want({ skill: "jump_to", goal }); }

  want(request) {
    if (this.skill === "walk" && !this.fallen) this.request = { ...request, ready: false, waited: 0 };
  }

  // Push the base for a time [s] with a force [N], world axes.
  push(force, seconds) {
    this.robot.push.splice(0, 3, ...force);
    this.pushSteps = Math.round(seconds / DT);
  }

  step() {
    const { robot } = this;
    if (this.pushSteps-- <= 0) robot.push.fill(0);
    if (this.fallen) { // the pose stays: links do not touch the ground, and the robot would sink into it
      this.fallenTime += DT;
      if (this.fallenTime > FALL_TIME) this.reset();
      return;
    }
    if (this.skill === "walk") this.walk();
    const policy = this.policies[this.skill];
    const readings = { ...robot.readings(), ...this.commands() };
    if (this.skill === "walk") readings.lin_vel[1] += BIAS;
    this.targets = policy.targets(readings);
    robot.step(this.targets, policy);
    if (this.skill !== "walk") this.advanceJump();
    if (!(robot.tilt < Math.PI / 3 && robot.height > 0.1)) {
      this.fallen = true;
      this.fallenTime = 0;
      this.request = null;
    }
  }

  // Return the readings of the command.
  commands() {
    const { jump } = this;
    const commanded = jump && jump.steps >= SQUAT;
    const way = jump?.goal ? this.robot.offset(jump.goal) : [0, 0];
    return {
      command: this.command.some((x) => Math.abs(x) >= 0.05) ? this.command : [0, 0, 0],
      wanted_height: [jump?.height ?? 0],
      jump_command: [commanded && jump.phase !== LANDED ? 1 : 0],
      goal: commanded ? way : [0, 0],
      way,
    };
  }

  // Command a velocity, the visitor's or one that leads to the requested jump, and begin that jump when at rest.
  walk() {
    const target = this.request ? this.approach(this.request) : this.velocity;
    Object.values(this.policies.walk.range).forEach(([low, high], i) => {
      const change = clamp(target[i], low, high) - this.command[i];
      this.command[i] += clamp(change, -SLEW, SLEW);
    });
    if (this.request?.ready && this.command.every((x) => Math.abs(x) < 0.05) && this.atRest() && this.nearDefault()) {
      const { robot, request } = this;
      const { ground, position: start } = robot;
      this.jump = { ...request, phase: STANCE, steps: 0, phaseSteps: 0, apex: 0, ground, start, path: [] };
      this.handOver(request.skill);
      this.request = null;
    }
  }

  // Return the velocity that brings the robot to where it can jump from.
  approach(request) {
    if (request.goal && !request.ready) {
      const [x, y] = this.robot.offset(request.goal);
      const excess = Math.max(0, Math.hypot(x, y) - reach(this.policies.jump_to)[1]);
      const bearing = Math.atan2(y, x);
      const toward = (gain, error, low, high) => Math.sign(error) * clamp(gain * Math.abs(error), low, high);
      if (Math.abs(bearing) > BEARING || excess !== 0) {
        const speed = excess ? toward(WALKING, excess, 0.15, 0.5) : 0;
        return [Math.abs(bearing) < 0.5 ? speed : 0, 0, toward(TURNING, bearing, 0.15, 1)];
      }
    }
    request.ready = true;
    request.waited += DT;
    const restless = request.waited > 2 && request.waited % 2 < 0.5;
    const crooked = !this.nearDefault() && request.waited % 1 > 0.4;
    return restless || crooked ? [0.25, 0, 0] : [0, 0, 0]; // steps of a robot that does not stand as before a jump
  }

  atRest() {
    const { robot } = this;
    return Math.min(...robot.contactTime) > 0.3 && Math.hypot(...robot.velocity) < 0.1
      && Math.hypot(...robot.data.qvel.slice(3, 6)) < 0.3 && robot.tilt < 0.14;
  }

  nearDefault() {
    const { robot, policies: { walk } } = this;
    return robot.q.every((i, m) => Math.abs(robot.data.qpos[i] - walk.default[m]) < 0.44);
  }

  // Make a skill active; its last action becomes the one that yields the present targets.
  handOver(skill) {
    this.skill = skill;
    this.command = [0, 0, 0];
    const policy = this.policies[skill];
    const { default_joint_pos: pose, action_scale: scale } = policy.interface;
    policy.reset(this.targets.map((target, i) => clamp((target - pose[i]) / scale[i], -1, 1)));
  }

  // Advance the phase of a jump after a policy step.
  advancePhase() {
    const { robot, jump } = this;
    jump.steps += 1;
    const rises = robot.velocity[2] > this.policies[this.skill].takeoff_speed;
    const before = jump.phase;
    if (before === STANCE && robot.contacts === 0 && rises) jump.phase = FLIGHT;
    if (before === FLIGHT && robot.contacts > 0 && !rises) jump.phase = LANDED;
    jump.phaseSteps = jump.phase === before ? jump.phaseSteps + 1 : 0;
    if (jump.phase === FLIGHT || jump.phase !== before) {
      jump.apex = Math.max(jump.apex, robot.position[2] - jump.ground);
      jump.path.push({ position: Array.from(robot.position), poses: robot.poses(new Float32Array(7 * robot.model.nbody)) });
    }
  }

  // Let walking take over after a landing, or from a jump that does not take off.
  advanceJump() {
    this.advancePhase();
    const { robot, jump } = this;
    const late = jump.phaseSteps >= 60 || robot.tilt > 0.35;
    const landed = jump.phase === LANDED && jump.phaseSteps >= 18 && (late || this.atRest());
    if (landed || (jump.phase === STANCE && jump.steps >= 150)) {
      this.handOver("walk");
      this.jump = null;
      const error = jump.goal ? Math.hypot(...robot.offset(jump.goal)) : jump.apex - jump.height;
      const length = Math.hypot(robot.position[0] - jump.start[0], robot.position[1] - jump.start[1]);
      this.finished({ height: jump.height, goal: jump.goal, apex: jump.apex, error, length, made: landed, path: jump.path });
    }
  }
}
