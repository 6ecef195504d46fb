// Checks of the runtime in Node: `node check.mjs conformance POLICY VECTORS` and `node check.mjs jumps SITE POLICY GOALS`.
// Prints one line of JSON.
import fs from "node:fs";
import zlib from "node:zlib";
import loadMujoco from "@mujoco/mujoco";
import { readPolicy } from "./policy.js";
import { MESHES, Robot } from "./robot.js";
import { Session } from "./session.js";

async function policyOf(folder) {
  const bytes = fs.readFileSync(`${folder}/policy.bin`);
  const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  return readPolicy(JSON.parse(fs.readFileSync(`${folder}/policy.json`)), buffer);
}

function vectorsOf(file) {
  const types = { float32: Float32Array, int64: BigInt64Array, bool: Uint8Array, uint8: Uint8Array };
  const decode = ({ dtype, shape, zlib_base64: text }) => {
    const bytes = Uint8Array.from(zlib.inflateSync(Buffer.from(text, "base64")));
    const width = shape.slice(1).reduce((a, b) => a * b, 1);
    const values = new types[dtype](bytes.buffer);
    return Array.from({ length: shape[0] ?? 1 }, (_, i) => values.subarray(i * width, (i + 1) * width));
  };
  const entries = Object.entries(JSON.parse(fs.readFileSync(file)));
  return Object.fromEntries(entries.filter(([, each]) => each.dtype).map(([name, each]) => [name, decode(each)]));
}

// Return the largest differences of observation, action and filtered target from recorded vectors.
async function conformance(folder, file) {
  const policy = await policyOf(folder);
  const vectors = vectorsOf(file);
  const worst = { observation: 0, action: 0, target: 0 };
  const compare = (kind, ours, theirs) => {
    if (ours.length !== theirs.length) worst[kind] = Infinity;
    ours.forEach((x, i) => { worst[kind] = Math.max(worst[kind], Math.abs(x - theirs[i])); });
  };
  const every = Number(vectors.observation_every[0][0]);
  for (let step = 0; step < vectors.action.length; step++) {
    if (vectors.reset[step][0]) policy.reset();
    const names = Object.keys(vectors).filter((name) => name.startsWith("reading_"));
    const readings = Object.fromEntries(names.map((name) => [name.slice(8), vectors[name][step]]));
    const observation = policy.observe(readings);
    if (step % every === 0) compare("observation", observation, vectors.observation[step / every]);
    compare("action", policy.act(observation), vectors.action[step]);
    policy.action = Float32Array.from(vectors.action[step]); // so that rounding does not add up
    const scale = policy.interface.action_scale;
    const target = Array.from(policy.action, (a, i) => policy.default[i] + scale[i] * a);
    compare("target", policy.filter(target, readings.angle, readings.rate), vectors.target[step]);
  }
  return { steps: vectors.action.length, ...worst };
}

// Return apex [m], and place of the base one second after touchdown [m], of jumps from rest commanded after 0.5 s.
async function jumps(site, name, list, scene = "plain") {
  const policy = await policyOf(`${site}/policies/${name}`);
  const robot = new Robot(await loadMujoco(), robotFiles(), scene);
  robot.friction = policy.friction;
  robot.gravity = policy.gravity;
  const results = [];
  for (const goal of JSON.parse(list)) {
    const session = new Session(robot, { walk: policy, [policy.skill]: policy });
    session.jump = { phase: 0, steps: 0, phaseSteps: 0, apex: 0, ground: robot.ground, path: [], ...goal };
    session.skill = policy.skill;
    const { jump } = session;
    policy.reset();
    let rest = 0;
    const times = [];
    for (let step = 0; step < 420 && rest < 60; step++) {
      const begin = performance.now();
      session.targets = policy.targets({ ...robot.readings(), ...session.commands() });
      robot.step(session.targets, policy);
      times.push(performance.now() - begin);
      session.advancePhase();
      rest += jump.phase === 2;
    }
    times.sort((a, b) => a - b);
    const ms = [0.5, 0.99].map((share) => times[Math.floor(share * times.length)]);
    results.push({ ...goal, apex: jump.apex, place: Array.from(robot.position.slice(0, 2)), tilt: robot.tilt, ms });
  }
  return results;
}

function robotFiles() {
  const folder = new URL("../../../assets/jumper/", import.meta.url);
  const files = MESHES.map((name) => [name, new Uint8Array(fs.readFileSync(new URL(`meshes/${name}.obj`, folder)))]);
  return { xml: fs.readFileSync(new URL("jumper.xml", folder), "utf8"), ...Object.fromEntries(files) };
}

const [command, ...args] = process.argv.slice(2);
console.log(JSON.stringify(await { conformance, jumps }[command](...args)));
