// The page: it connects controls, worker and picture, and shows figures and messages.
import { Controls } from "./controls.js";
import { Scene } from "./scene.js";

const PUSH = [70, 0.2]; // [N], [s] of the push key
const SLIP = 0.15; // [m/s] mean speed of the fastest paw on the ground from which a walk slips
const TOUCH = matchMedia("(pointer: coarse)").matches;
const HINTS = [ // before the first jump, before the second, and after it
  TOUCH ? "Tap the ground: the robot jumps there. The stick walks."
    : "Click the ground: the robot jumps there. <kbd>W</kbd><kbd>A</kbd><kbd>S</kbd><kbd>D</kbd> walk, <kbd>space</kbd> jumps up.",
  "Drag turns the view, wheel or pinch zooms, click the robot to jump up.", "",
];
const PLANETS = { Earth: 9.81, Mars: 3.71, Moon: 1.62 };
const $ = (id) => document.getElementById(id);
const meters = (x, digits = 2) => `${x.toFixed(digits)} m`;

const scene = new Scene($("view"));
const worker = new Worker("physics.js", { type: "module" });
const page = { scene, send, state: null, jumps: [] }; // also for tests
window.page = page;
let name = "plain";
let dark = (localStorage.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
let info = null; // of the open scene
let top = 0; // [m] largest height of the flight so far
let notice = 0; // timer of a message

function send(type, content = {}) {
  if (info) worker.postMessage({ type, ...content });
}

// Show a message for some time [ms], then the hint again; 0: until the next one.
function say(text, time = 6000, kind = "") {
  clearTimeout(notice);
  $("hint").innerHTML = text;
  $("hint").className = kind;
  if (time) notice = setTimeout(hint, time);
}

const hint = () => say(HINTS[Math.min(page.jumps.length, 2)], 0);

// Clear numbers, messages and ghost of the last jump; small: text below the number.
function clear(small = "") {
  figure("", small);
  scene.showJump(null);
  hint();
}

const distance = ([x, y]) => Math.hypot(x - page.state.position[0], y - page.state.position[1]);

const ready = () => info && page.state?.skill === "walk" && !page.state.fallen;
const wait = () => info && say("Wait until it stands.", 1500);
const within = (place) => distance(place) >= info.reach[0] && distance(place) <= info.reach[1];

const actions = {
  walk: (velocity) => send("walk", { velocity }),
  jumpUp: () => {
    if (!ready()) return wait();
    const height = Number($("height").value);
    clear(`${meters(height)} asked`);
    send("jumpUp", { height });
  },
  jumpTo: (place) => {
    if (!ready()) return wait();
    if (distance(place) < info.reach[0]) return say(`Too near: a jump ahead is at least ${meters(info.reach[0], 1)}.`, 3000);
    clear(`${meters(distance(place))} away`);
    if (!within(place)) say(`Too far for one jump of ${meters(info.reach[1], 1)}: it walks nearer first.`);
    send("jumpTo", { goal: place });
  },
  push: () => {
    const angle = 2 * Math.PI * Math.random();
    send("push", { force: [PUSH[0] * Math.cos(angle), PUSH[0] * Math.sin(angle), 0], seconds: PUSH[1] });
    say(`Pushed with ${PUSH[0]} N for ${PUSH[1]} s. You can also drag the robot.`, 3000);
  },
  drag: (target) => send("drag", { target }),
  hover: (place) => scene.mark("hover", ready() ? place : null, place && ready() && within(place)),
  reset: () => {
    send("reset");
    scene.resetView();
  },
};

function figure(big, small) {
  $("big").textContent = big;
  $("small").textContent = small;
}

const receive = {
  scene: (data) => {
    info = data;
    scene.setRobot(data.shapes);
    scene.setGround(data.scene, dark);
    Object.assign($("height"), { min: Math.max(data.heights[0], 0.5), max: (data.heights[1] - 0.05).toFixed(2) });
    setSlider("height", data.scene === "mars" ? 2.5 : 0.9);
    setSlider("gravity", data.gravity);
    setSlider("friction", data.friction);
    $("names").textContent = data.policies.join(", ");
    $("loading").hidden = true;
    page.opened = data.scene;
    hint();
  },
  state: (state) => {
    state.slip = 0.9 * (page.state?.slip ?? 0) + 0.1 * state.slip;
    const cancelled = page.state?.waiting && !state.waiting && state.skill === "walk";
    if (cancelled || state.time < page.state?.time) clear(); // time falls at a reset
    const key = TOUCH ? "Tap Reset" : "Press <kbd>R</kbd>";
    if (state.fallen && !page.state?.fallen) say(`It fell and starts again in a moment. ${key} to start at once.`, 2500, "bad");
    top = state.phase === 1 ? Math.max(top, state.height) : 0;
    if (top) figure(meters(top), $("small").textContent);
    page.state = state;
    const motion = `${meters(state.height)} high · ${speed(state.velocity).toFixed(1)} m/s`;
    $("status").textContent = state.fallen ? "fell" : `${doing(state)} · ${motion}`;
    scene.update(state.poses, 1000 / 60 / state.speed);
    scene.mark("goal", state.goal, state.goal && distance(state.goal) <= info.reach[1]);
  },
  jump: (jump) => {
    page.jumps.push(jump);
    scene.showJump(jump);
    hint();
    if (!jump.made) figure("no jump", "It stayed on the ground.");
    else if (jump.height) figure(meters(jump.apex, 3), `reached, ${meters(jump.height)} asked`);
    else figure(`${(100 * jump.error).toFixed(1)} cm off`, `${meters(jump.length)} far, ${meters(jump.apex)} high`);
  },
  error: ({ text }) => {
    $("loading").hidden = true;
    say(text.replaceAll("<", "&lt;"), 10000, "bad");
  },
};

worker.onmessage = ({ data }) => receive[data.type](data);
worker.onerror = () => receive.error({ text: "This browser cannot run the physics: it needs WebAssembly and module workers." });

function open(next) {
  name = next;
  info = null;
  $("loading").hidden = false;
  $("scene").blur();
  figure("", "");
  worker.postMessage({ type: "open", scene: name });
}

function setSlider(id, value) {
  $(id).value = value;
  $(id).oninput();
}

// Connect a slider to a value of the worker, and show it with its unit.
function slider(id, text, send) {
  $(id).oninput = () => { $(`${id}-value`).textContent = text(Number($(id).value)); };
  $(id).addEventListener("input", () => send?.(Number($(id).value)));
}

const set = (key) => (value) => {
  send("set", { name: key, value });
  const other = key === "gravity" && Math.abs(value - info?.gravity) > 1;
  if (other) say("These policies were trained with the gravity of this scene: with another one they miss or fall.");
};
slider("height", (x) => meters(x));
slider("friction", (x) => x.toFixed(2), set("friction"));
slider("payload", (x) => `${x.toFixed(1)} kg`, set("payload"));
slider("speed", (x) => `${x.toFixed(2)} ×`, set("speed"));
slider("gravity", (x) => {
  const planet = Object.keys(PLANETS).find((key) => Math.abs(PLANETS[key] - x) < 0.06);
  return planet ?? `${x.toFixed(1)} m/s²`;
}, set("gravity"));
for (const [planet, gravity] of Object.entries(PLANETS)) {
  $(planet).onclick = () => {
    setSlider("gravity", gravity);
    set("gravity")(gravity);
  };
}
$("scene").onchange = ({ target }) => open(target.value);
for (const id of ["jumpUp", "push", "reset"]) $(id).onclick = actions[id];
for (const each of document.querySelectorAll("button, input, summary")) each.addEventListener("pointerup", () => each.blur());
$("theme").onclick = () => {
  dark = !dark;
  localStorage.theme = dark ? "dark" : "light";
  paint();
};

function paint() {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  scene.setGround(name, dark);
}

// Run a policy of the visitor's own: files of a folder that `jumper export` wrote.
async function take(files) {
  const find = (ending) => files.find((file) => file.name === ending);
  const [json, bin] = [find("policy.json"), find("policy.bin")];
  if (!json || !bin) return say("This folder has no policy.json and policy.bin: export the policy again.", 10000, "bad");
  try {
    send("policy", { description: JSON.parse(await json.text()), bytes: await bin.arrayBuffer(), scene: name });
  } catch {
    say("policy.json is damaged: export the policy again.", 10000, "bad");
  }
}

// Return the files of dropped files and folders.
async function filesOf(items) {
  const read = async (entry) => {
    if (entry instanceof File) return [entry];
    if (entry.isFile) return [await new Promise((resolve, reject) => { entry.file(resolve, reject); })];
    const entries = await new Promise((resolve, reject) => { entry.createReader().readEntries(resolve, reject); });
    return (await Promise.all(entries.map(read))).flat();
  };
  return (await Promise.all(items.map((item) => item.webkitGetAsEntry() ?? item.getAsFile()).map(read))).flat();
}

addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", async (event) => {
  event.preventDefault();
  take(await filesOf([...event.dataTransfer.items]));
});
$("files").onchange = () => take([...$("files").files]);
addEventListener("resize", () => scene.resize());
addEventListener("pointerdown", (event) => { // a tap beside open settings closes them only
  if (!TOUCH || !$("panel").open || event.target !== scene.canvas) return;
  $("panel").open = false;
  event.stopPropagation();
}, true);
const controls = new Controls(scene, $("stick"), actions);

const speed = ([x, y]) => Math.hypot(x, y);

// Return what the robot does, in a word or two.
function doing({ skill, phase, waiting, velocity, slip }) {
  if (skill !== "walk") return ["crouches", "flies", "lands"][phase];
  if (waiting) return "gets ready";
  return speed(velocity) < 0.05 ? "stands" : slip > SLIP ? "slips" : "walks";
}

function frame(now) {
  controls.poll();
  scene.draw(now);
  requestAnimationFrame(frame);
}

paint();
open(name);
requestAnimationFrame(frame);
