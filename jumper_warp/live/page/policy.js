// A policy: observation with history, network, and motor command filter, as in training.
// `policy.json` and `policy.bin` are written by `jumper export`; see docs/reference/formats.md.

export const FORMAT = "jumper-warp policy for browsers 1";
const COMMAND_BOUND = 4 * Math.PI; // [rad] motor targets are clipped to ± this before the filter
const ACTIVATIONS = { elu: (x) => (x > 0 ? x : Math.expm1(x)), relu: (x) => Math.max(x, 0), tanh: Math.tanh };
// Observation terms that the physics computes, and their numbers of values.
export const TERMS = {
  command: 3, wanted_height: 1, jump_command: 1, goal: 2, way: 2, height: 1, lin_vel: 3, ang_vel: 3, gravity: 3,
  angle: 12, rate: 12, last_action: 12, block_ahead: 7,
};
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

// Return a policy, made of the parsed policy.json and the bytes of policy.bin. Throws an Error with one line.
export async function readPolicy(description, bytes) {
  const fail = (text) => { throw new Error(`${description?.name ?? "policy.json"}: ${text}`); };
  if (description?.format !== FORMAT) fail("not a policy for this page; write it with jumper export");
  const count = description.sizes.reduce((sum, out, i, all) => sum + (i ? out * (all[i - 1] + 1) : 2 * out), 0);
  if (bytes.byteLength !== 4 * count) fail(`policy.bin must have ${4 * count} bytes, got ${bytes.byteLength}`);
  if (globalThis.crypto?.subtle) { // browsers have it for https and localhost only
    const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
    const hash = Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
    if (hash !== description.sha256) fail("policy.bin is damaged");
  }
  for (const [name, term] of Object.entries(description.interface.observation_layout)) {
    if (TERMS[name] * term.history !== term.end - term.first) fail(`the page cannot compute the observation ${name}`);
  }
  return new Policy(description, new Float32Array(bytes));
}

export class Policy {
  constructor(description, values) {
    Object.assign(this, description);
    const face = this.interface;
    this.layout = Object.entries(face.observation_layout);
    this.default = face.default_joint_pos;
    let at = 0;
    const take = (count) => values.subarray(at, (at += count));
    const sizes = this.sizes;
    this.mean = take(sizes[0]);
    this.std = take(sizes[0]);
    this.layers = sizes.slice(1).map((out, i) => ({ weight: take(out * sizes[i]), bias: take(out) }));
    this.activation = ACTIVATIONS[face.activation];
    this.limits = {};
    for (const kind of ["lateral", "transversal", "sum"]) {
      const degrees = Object.entries(face.command_filter[kind]);
      this.limits[kind] = Object.fromEntries(degrees.map(([key, angle]) => [key, (angle * Math.PI) / 180]));
    }
    this.reset();
  }

  // Clear the history; action: of the policy step before, as if this policy had been active.
  reset(action = new Float32Array(12)) {
    this.action = Float32Array.from(action);
    this.frames = {};
  }

  // Return the observation, and append the readings, arrays by term, to the history. `angle` is the true motor angle.
  observe(readings) {
    const observation = new Float32Array(this.sizes[0]);
    for (const [name, term] of this.layout) {
      const value = Array.from(name === "last_action" ? this.action : readings[name]);
      const centred = name === "angle" ? value.map((angle, i) => angle - this.default[i]) : value;
      const frame = centred.map((x) => term.scale * clamp(x, -term.clip, term.clip));
      const past = this.frames[name];
      this.frames[name] = past ? [...past.slice(1), frame] : Array(term.history).fill(frame);
      observation.set(this.frames[name].flat(), term.first);
    }
    return observation;
  }

  // Return the action, (12,), within ±1, of an observation.
  act(observation) {
    const { observation_limit: raw, normalised_limit: normalised } = this.interface;
    let x = observation.map((value, i) => {
      const limited = Number.isFinite(value) ? clamp(value, -raw, raw) : 0;
      return clamp((limited - this.mean[i]) / this.std[i], -normalised, normalised);
    });
    this.layers.forEach(({ weight, bias }, layer) => {
      const out = new Float32Array(bias.length);
      const width = x.length;
      for (let row = 0, at = 0; row < out.length; row++) {
        let sum = bias[row];
        for (let column = 0; column < width; column++) sum += weight[at++] * x[column];
        out[row] = layer < this.layers.length - 1 ? this.activation(sum) : clamp(sum, -1, 1);
      }
      x = out;
    });
    this.action = x;
    return x;
  }

  // Return the motor targets of a policy step [rad], (12,).
  targets(readings) {
    const action = this.act(this.observe(readings));
    const scale = this.interface.action_scale;
    return this.filter(Array.from(action, (a, i) => this.default[i] + scale[i] * a), readings.angle, readings.rate);
  }

  // Return motor targets after the command filter, which keeps joints off their stops and links apart.
  filter(target, angle, rate) {
    const out = target.map((x) => clamp(x, -COMMAND_BOUND, COMMAND_BOUND));
    for (let m = 0; m < 12; m++) {
      out[m] = this.limit(out[m], angle[m], rate[m], m % 3 ? this.limits.transversal : this.limits.lateral);
    }
    for (let m = 1; m < 12; m += 3) {
      const total = out[m] + out[m + 1];
      const limited = this.limit(total, angle[m] + angle[m + 1], rate[m] + rate[m + 1], this.limits.sum);
      out[m] += 0.5 * (limited - total);
      out[m + 1] += 0.5 * (limited - total);
    }
    return out;
  }

  // Return the filtered command [rad] of one angle or sum of angles.
  limit(command, pos, vel, { lower, upper, lower_zone: lowerZone, upper_zone: upperZone }) {
    const { speed_floor, horizon } = this.interface.command_filter;
    const floor = (speed_floor * Math.PI) / 180;
    const above = upper - pos;
    const below = pos - lower;
    const time = Math.min(above / Math.max(vel, floor), below / Math.max(-vel, floor));
    let weight = clamp(1 - time / horizon, 0, 1);
    if (above < upperZone || below < lowerZone) weight = 0;
    if ((above < upperZone && command > pos) || (below < lowerZone && command < pos)) weight = 1;
    if (above < 0 || below < 0) weight = 1;
    return command + weight * (clamp(command, lower, upper) - command);
  }
}
