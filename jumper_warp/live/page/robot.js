// The robot in MuJoCo: model and ground, motors, readings. World z is up; quaternions are wxyz.
import { boxesOf, rough, surface } from "./ground.js";

export const LEGS = ["FL", "FR", "BL", "BR"];
export const MESHES = ["shank", "shell", "spine", "thigh"];
const SUBSTEPS = 8; // physics steps of a policy step
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

// Return a vector in the axes of a body with quaternion q.
export function toBody([w, x, y, z], [a, b, c]) {
  const t = [2 * (z * b - y * c), 2 * (x * c - z * a), 2 * (y * a - x * b)];
  return [a + w * t[0] + z * t[1] - y * t[2], b + w * t[1] + x * t[2] - z * t[0], c + w * t[2] + y * t[0] - x * t[1]];
}

export class Robot {
  // mujoco: the loaded module; files: text of jumper.xml as `xml`, and bytes of the meshes by name.
  constructor(mujoco, files, scene = "plain") {
    this.mujoco = mujoco;
    this.scene = scene;
    const vfs = new mujoco.MjVFS();
    for (const name of MESHES) vfs.addBuffer(`meshes/${name}.obj`, files[name]);
    this.model = mujoco.MjModel.from_xml_string(sceneXml(files.xml, scene), vfs);
    this.data = new mujoco.MjData(this.model);
    vfs.delete();
    const { model } = this;
    if (scene === "rough") model.hfield_data.set(rough().data);
    const joints = LEGS.flatMap((leg) => ["lateral", "outer", "inner"].map((motor) => `${leg}_${motor}`));
    const ids = joints.map((name) => mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT.value, name));
    this.q = ids.map((id) => model.jnt_qposadr[id]);
    this.v = ids.map((id) => model.jnt_dofadr[id]);
    this.base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY.value, "body");
    this.paws = LEGS.map((leg) => mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM.value, `${leg}_paw`));
    for (let i = 0; i < 12; i++) { // torques of motors are computed here; the model's actuators damp the knees only
      model.actuator_gainprm[10 * i] = 0;
      model.actuator_biasprm.fill(0, 10 * i, 10 * i + 10);
    }
    this.folds = model.tendon_range.slice(0, 2);
    for (let i = 0; i < 4; i++) model.tendon_range.set([-9, 9], 2 * i); // these stops are computed here, as on SolverMuJoCo
    this.nominal = { mass: model.body_mass[this.base], inertia: model.body_inertia.slice(3 * this.base, 3 * this.base + 3) };
    this.push = [0, 0, 0, 0, 0, 0]; // force [N] and torque [N m] on the base, world axes
    this.reset();
  }

  free() {
    this.data.delete();
    this.model.delete();
  }

  // Put the robot at rest in the default pose, on the ground.
  reset() {
    this.mujoco.mj_resetDataKeyframe(this.model, this.data, 0);
    this.data.qpos[2] += surface(this.scene, 0, 0);
    this.mujoco.mj_forward(this.model, this.data);
    this.contactTime = [0, 0, 0, 0];
    this.places = [[0, 0], [0, 0], [0, 0], [0, 0]]; // [m] of the paws after the last policy step
    this.slip = 0; // [m/s] largest speed of a paw on the ground
    this.push.fill(0);
  }

  set friction(value) {
    for (const paw of this.paws) this.model.geom_friction[3 * paw] = value;
  }

  set gravity(value) {
    this.model.opt.gravity[2] = -value;
  }

  // Mass added to the base [kg]; its inertia grows by the same factor.
  set payload(mass) {
    const { model, data, mujoco, base, nominal } = this;
    const state = [data.qpos.slice(), data.qvel.slice()];
    model.body_mass[base] = nominal.mass + mass;
    nominal.inertia.forEach((value, i) => { model.body_inertia[3 * base + i] = value * (1 + mass / nominal.mass); });
    mujoco.mj_setConst(model, data);
    data.qpos.set(state[0]);
    data.qvel.set(state[1]);
    mujoco.mj_forward(model, data);
  }

  // Advance a policy step towards motor targets [rad], (12,).
  step(targets, policy) {
    const { data, model, mujoco } = this;
    data.xfrc_applied.set(this.push, 6 * this.base);
    for (let substep = 0; substep < SUBSTEPS; substep++) {
      const { qpos, qvel, qfrc_applied: applied } = data;
      for (let i = 0; i < 12; i++) {
        const rate = qvel[this.v[i]];
        applied[this.v[i]] = motorTorque(policy, i, targets[i], qpos[this.q[i]], rate);
      }
      for (let i = 1; i < 12; i += 3) {
        const [a, b] = [this.v[i], this.v[i + 1]];
        const stop = stopTorque(qpos[this.q[i]] + qpos[this.q[i + 1]], qvel[a] + qvel[b], this.folds);
        applied[a] += stop;
        applied[b] += stop;
      }
      mujoco.mj_step(model, data);
    }
    const force = data.sensordata; // [N] of the paws
    const dt = SUBSTEPS * model.opt.timestep;
    const places = this.paws.map((paw) => Array.from(data.geom_xpos.subarray(3 * paw, 3 * paw + 2)));
    const speeds = places.map(([x, y], leg) => Math.hypot(x - this.places[leg][0], y - this.places[leg][1]) / dt);
    this.slip = Math.max(...speeds.map((speed, leg) => (force[leg] > 0.1 && this.contactTime[leg] > 0 ? speed : 0)));
    this.places = places;
    this.contactTime = this.contactTime.map((time, leg) => (force[leg] > 0.1 ? time + dt : 0));
  }

  get position() { return this.data.qpos.slice(0, 3); }
  get velocity() { return this.data.qvel.slice(0, 3); }
  get quat() { return this.data.qpos.slice(3, 7); }
  get tilt() { return Math.acos(clamp(toBody(this.quat, [0, 0, 1])[2], -1, 1)); }
  get contacts() { return this.contactTime.filter((time) => time > 0).length; }
  get ground() { return surface(this.scene, this.data.qpos[0], this.data.qpos[1]); }
  get height() { return this.data.qpos[2] - this.ground; }

  get yaw() {
    const [w, x, y, z] = this.quat;
    return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
  }

  // Return the horizontal vector [m] from the base to a place, ahead and to the left.
  offset([x, y]) {
    const [px, py] = this.position;
    const [c, s] = [Math.cos(this.yaw), Math.sin(this.yaw)];
    return [c * (x - px) + s * (y - py), c * (y - py) - s * (x - px)];
  }

  // Return the readings of the robot's state; those of the command are the session's.
  readings() {
    const { qpos, qvel } = this.data;
    const { quat } = this;
    return {
      height: [this.height],
      lin_vel: toBody(quat, this.velocity),
      ang_vel: Array.from(qvel.slice(3, 6)),
      gravity: toBody(quat, [0, 0, -1]),
      angle: this.q.map((i) => qpos[i]),
      rate: this.v.map((i) => qvel[i]),
      block_ahead: this.blockAhead(),
    };
  }

  // Return the distances [m] at which three rays ahead enter and leave the next block, and its height [m].
  blockAhead() {
    const [x, y] = this.position;
    const floor = this.ground;
    const heading = [Math.cos(this.yaw), Math.sin(this.yaw)];
    const rays = [0.2, 0, -0.2].map((side) => [x - side * heading[1], y + side * heading[0]]);
    const edges = (box, from) => {
      let [enter, leave] = [-Infinity, Infinity];
      for (const axis of [0, 1]) {
        const d = Math.abs(heading[axis]) < 1e-6 ? 1e-6 : heading[axis];
        const ends = [-1, 1].map((side) => (box.center[axis] + side * box.half[axis] - from[axis]) / d);
        enter = Math.max(enter, Math.min(...ends));
        leave = Math.min(leave, Math.max(...ends));
      }
      return enter < leave && enter <= 2 ? [clamp(enter, -2, 2), clamp(leave, -2, 2)] : [2, 2];
    };
    const seen = boxesOf(this.scene).map((box) => ({ box, all: rays.map((from) => edges(box, from)) }));
    const ahead = seen.filter(({ all }) => all.some(([enter, leave]) => enter < 2 && leave > 0));
    const on = ahead.find(({ box }) => Math.abs(box.height - floor) < 1e-6 && floor > 0); // the one it stands on first
    const next = on ?? ahead.sort((a, b) => a.all[1][0] - b.all[1][0])[0];
    return next ? [...next.all.flat(), next.box.height] : [2, 2, 2, 2, 2, 2, 0];
  }

  // Write positions [m] and quaternions of all bodies to `out`, 7 values each.
  poses(out) {
    const { xpos, xquat } = this.data;
    for (let body = 0; body < this.model.nbody; body++) {
      out.set(xpos.subarray(3 * body, 3 * body + 3), 7 * body);
      out.set(xquat.subarray(4 * body, 4 * body + 4), 7 * body + 3);
    }
    return out;
  }

  // Return the shapes of the robot to draw: type, size, colour, body, pose in the body, and vertices of meshes.
  shapes() {
    const { model } = this;
    const shapes = [];
    for (let i = 0; i < model.ngeom; i++) {
      if (model.geom_group[i] !== 2) continue;
      const part = (array, n, at = i) => Array.from(array.subarray(n * at, n * at + n));
      const shape = {
        type: model.geom_type[i], body: model.geom_bodyid[i], size: part(model.geom_size, 3), color: part(model.geom_rgba, 4),
        pos: part(model.geom_pos, 3), quat: part(model.geom_quat, 4),
      };
      const mesh = model.geom_dataid[i];
      if (mesh >= 0) {
        const slice = (array, from, count) => array.slice(3 * from[mesh], 3 * (from[mesh] + count[mesh]));
        shape.vertices = slice(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum);
        shape.faces = slice(model.mesh_face, model.mesh_faceadr, model.mesh_facenum);
      }
      shapes.push(shape);
    }
    return shapes;
  }
}

// Return the torque [N m] of the stops of a sum of angles [rad] with a rate [rad/s]; damped on the way in only.
function stopTorque(angle, rate, [lower, upper]) {
  const beyond = angle - clamp(angle, lower, upper);
  return beyond ? -1000 * beyond - (beyond * rate > 0 ? 2 * rate : 0) : 0;
}

// Return the torque [N m] of motor i for its target [rad] at an angle [rad] and rate [rad/s].
function motorTorque(policy, i, target, angle, rate) {
  const { interface: face, motors, fade: [start, end] } = policy;
  const span = motors.no_load_speed[i] - motors.cutoff_speed[i];
  const most = (way) => {
    const headroom = clamp((motors.no_load_speed[i] - way * rate) / span, 0, 1);
    return Math.min(face.torque_limit[i], motors.peak[i] * headroom);
  };
  const command = face.joint_stiffness[i] * (target - angle) - face.joint_damping[i] * rate;
  return clamp(command, -most(-1), most(1)) * clamp((end - Math.abs(rate)) / (end - start), 0, 1);
}

// Return the robot's MJCF with the ground of a scene, and sensors of the paws' forces.
function sceneXml(xml, scene) {
  const boxes = boxesOf(scene).map(({ center: [x, y], half: [a, b], height }) =>
    `<geom type="box" pos="${x} ${y} ${height / 2}" size="${a} ${b} ${height / 2}" contype="0" conaffinity="1"/>`);
  let field = "";
  if (scene === "rough") {
    const { cells, half, top } = rough();
    field = `<asset><hfield name="rough" nrow="${cells}" ncol="${cells}" size="${half} ${half} ${top} 0.1"/></asset>`;
    boxes.push('<geom type="hfield" hfield="rough" contype="0" conaffinity="1"/>');
  }
  const touch = LEGS.map((leg) => `<touch site="${leg}_ankle_parent"/>`).join("");
  const zones = xml.replace(/name="\w\w_ankle_parent"/g, '$& size="0.04"'); // a sensor counts contacts within its site
  return zones.replace("</worldbody>", `${boxes.join("")}</worldbody>${field}<sensor>${touch}</sensor>`);
}
