// Worker: MuJoCo and the policies in real time. Receives requests of the page, and posts the state after each step.
import loadMujoco from "@mujoco/mujoco";
import { readPolicy } from "./policy.js";
import { MESHES, Robot } from "./robot.js";
import { DT, Session, reach } from "./session.js";

const LATE = 100; // [ms] delay after which the clock restarts, instead of catching up
const PULL = [600, 40, 160]; // [N/m], [N s/m], [N] of a robot that the visitor drags
const values = { friction: null, payload: 0, gravity: null, speed: 1 }; // null: those of the scene's policies
const policies = {}; // by name
const own = {}; // dropped by the visitor, by skill
let files;
let mujoco;
let scenes;
let robot;
let session;
let due = 0;

const url = (path) => new URL(path, self.location.href);
const post = (type, content = {}, transfer = []) => self.postMessage({ type, ...content }, transfer);

async function get(path, kind) {
  const answer = await fetch(url(path));
  if (!answer.ok) throw new Error(`${path} is missing (${answer.status})`);
  return answer[kind]();
}

async function policy(name) {
  const folder = `policies/${name}/policy`;
  policies[name] ??= readPolicy(...await Promise.all([get(`${folder}.json`, "json"), get(`${folder}.bin`, "arrayBuffer")]));
  return policies[name];
}

// Load robot and policies of a scene, and begin.
async function open(scene) {
  const names = Object.entries((scenes ??= await get("scenes.json", "json"))[scene]);
  const loading = Promise.all(names.map(async ([skill, name]) => [skill, own[skill] ?? await policy(name)]));
  if (!mujoco) {
    const bytes = MESHES.map(async (name) => [name, new Uint8Array(await get(`meshes/${name}.obj`, "arrayBuffer"))]);
    [mujoco, files] = await Promise.all([
      loadMujoco({ locateFile: (name) => url(name).href }),
      Promise.all([get("jumper.xml", "text"), ...bytes]).then(([xml, ...rest]) => ({ xml, ...Object.fromEntries(rest) })),
    ]);
  }
  const loaded = Object.fromEntries(await loading);
  robot?.free();
  robot = new Robot(mujoco, files, scene);
  session = new Session(robot, loaded, report);
  values.gravity = loaded.jump_up.gravity;
  values.friction ??= loaded.walk.friction;
  apply();
  post("scene", {
    scene, shapes: robot.shapes(), gravity: values.gravity, friction: values.friction, reach: reach(loaded.jump_to),
    heights: Object.values(loaded.jump_up.range)[0], policies: Object.values(loaded).map((each) => each.name),
  });
}

function apply() {
  for (const name of ["friction", "payload", "gravity"]) robot[name] = values[name];
}

// Post the outcome of a jump, the pose at its apex and the path of the base.
function report({ path, ...outcome }) {
  const top = path.reduce((best, each) => (each.position[2] > best.position[2] ? each : best), path[0]);
  post("jump", { ...outcome, poses: top?.poses, path: Float32Array.from(path.flatMap((each) => each.position)) });
}

function step() {
  if (session.drag && !session.fallen) {
    const { position, velocity } = robot;
    const force = session.drag.map((target, i) => PULL[0] * (target - position[i]) - PULL[1] * velocity[i]);
    const size = Math.hypot(...force);
    session.push(force.map((x) => x * Math.min(1, PULL[2] / size)), DT);
  }
  session.step();
  const poses = robot.poses(new Float32Array(7 * robot.model.nbody));
  post("state", {
    poses, skill: session.skill, phase: session.jump?.phase, position: Array.from(robot.position), yaw: robot.yaw,
    height: robot.height, velocity: Array.from(robot.velocity), slip: robot.slip, fallen: session.fallen, speed: values.speed,
    goal: session.request?.goal ?? session.jump?.goal ?? null, time: robot.data.time, waiting: session.request !== null,
  }, [poses.buffer]);
}

function loop() {
  const now = performance.now();
  if (due < now - LATE) due = now;
  while (session && due <= now) {
    step();
    due += (1000 * DT) / values.speed;
  }
  setTimeout(loop, Math.max(0, due - performance.now()));
}

const actions = {
  open: ({ scene }) => open(scene),
  walk: ({ velocity }) => {
    session.velocity = velocity;
    if (velocity.some((x) => x)) session.request = null;
  },
  jumpUp: ({ height }) => session.jumpUp(height),
  jumpTo: ({ goal }) => session.jumpTo(goal),
  push: ({ force, seconds }) => session.push(force, seconds),
  drag: ({ target }) => { session.drag = target; },
  reset: () => session.reset(),
  set: ({ name, value }) => {
    values[name] = value;
    if (name !== "speed") apply();
  },
  policy: async ({ description, bytes, scene }) => {
    const dropped = await readPolicy(description, bytes);
    own[dropped.skill] = dropped;
    await open(scene);
  },
};

self.onmessage = async ({ data }) => {
  try {
    await actions[data.type](data);
  } catch (error) {
    post("error", { text: error.message });
  }
};
loop();
