// Controls of the visitor: keys, gamepad, stick of a touch screen, and pointer on the picture.
const SPEEDS = [0.7, 0.35, 1]; // ahead, left [m/s], about z [rad/s] of a held key or full deflection
const KEYS = {
  w: [1, 0, 0], arrowup: [1, 0, 0], s: [-1, 0, 0], arrowdown: [-1, 0, 0], a: [0, 0, 1], arrowleft: [0, 0, 1],
  d: [0, 0, -1], arrowright: [0, 0, -1], q: [0, 1, 0], e: [0, -1, 0],
};
const CLICK = [7, 500]; // [px], [ms] largest motion and duration of a click
const DEAD = 0.15; // deflection of a gamepad that counts as none

export class Controls {
  // actions: jumpUp(), jumpTo(place), walk(velocity), drag(target or null), hover(place or null), and by key p, r, h.
  constructor(scene, stick, actions) {
    Object.assign(this, { scene, actions });
    this.held = new Set();
    this.stick = [0, 0, 0];
    this.sent = "0,0,0";
    this.padPressed = [];
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.held.clear());
    this.listenToPointer(scene.canvas);
    this.listenToStick(stick);
  }

  key(event, down) {
    const key = event.key.toLowerCase();
    if (/SELECT|TEXTAREA/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
    const slider = event.target.type === "range" && key.startsWith("arrow");
    if (KEYS[key] && !slider) {
      this.held[down ? "add" : "delete"](key);
      event.preventDefault();
    } else if (down && !event.repeat) {
      const action = { " ": "jumpUp", p: "push", r: "reset" }[key];
      if (!action) return;
      event.preventDefault();
      this.actions[action]();
    }
  }

  // Send the velocity of keys, stick and gamepad if it has changed; call it each frame.
  poll() {
    const sum = [...this.stick];
    for (const key of this.held) KEYS[key].forEach((x, i) => { sum[i] += x; });
    const pad = [...(navigator.getGamepads?.() ?? [])].find(Boolean);
    if (pad) {
      const axis = (i) => (Math.abs(pad.axes[i] ?? 0) > DEAD ? -pad.axes[i] : 0);
      [axis(1), axis(0), axis(2)].forEach((x, i) => { sum[i] += x; });
      ["jumpUp", "push", "reset"].forEach((action, i) => {
        const pressed = Boolean(pad.buttons[i]?.pressed);
        if (pressed && !this.padPressed[i]) this.actions[action]();
        this.padPressed[i] = pressed;
      });
    }
    const velocity = sum.map((x, i) => Math.min(1, Math.max(-1, x)) * SPEEDS[i]);
    if (String(velocity) === this.sent) return;
    this.sent = String(velocity);
    this.actions.walk(velocity);
  }

  listenToPointer(canvas) {
    const { scene, actions } = this;
    const pointers = new Map();
    let drags = false;
    const moved = (event) => {
      const begin = pointers.get(event.pointerId);
      return Math.hypot(event.clientX - begin.x, event.clientY - begin.y) > CLICK[0];
    };
    canvas.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, time: event.timeStamp, alone: pointers.size === 0 });
      if (pointers.size > 1) pointers.forEach((pointer) => { pointer.alone = false; });
      drags = pointers.size === 1 && scene.onRobot(event.clientX, event.clientY);
      if (drags) scene.orbit.enabled = false;
      canvas.setPointerCapture(event.pointerId);
      actions.hover(null);
    }, true);
    canvas.addEventListener("pointermove", (event) => {
      if (!pointers.size) {
        const free = event.pointerType === "mouse" && !scene.onRobot(event.clientX, event.clientY);
        canvas.style.cursor = free ? "crosshair" : "grab";
        actions.hover(free ? scene.place(event.clientX, event.clientY) : null);
      } else if (drags && pointers.has(event.pointerId) && moved(event)) {
        actions.drag(scene.besideRobot(event.clientX, event.clientY));
      }
    });
    const end = (event) => {
      const begin = pointers.get(event.pointerId);
      if (!begin) return;
      const click = event.type === "pointerup" && begin.alone && !moved(event) && event.timeStamp - begin.time < CLICK[1];
      pointers.delete(event.pointerId);
      if (drags) {
        actions.drag(null);
        scene.orbit.enabled = true;
        if (click) actions.jumpUp();
      } else if (click) {
        const place = scene.place(event.clientX, event.clientY);
        if (place) actions.jumpTo(place);
      }
      drags = false;
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("pointerleave", () => actions.hover(null));
  }

  listenToStick(stick) {
    const knob = stick.firstElementChild;
    const move = (event) => {
      const { left, top, width } = stick.getBoundingClientRect();
      let [x, y] = [event.clientX - left - width / 2, event.clientY - top - width / 2].map((d) => (2 * d) / width);
      const size = Math.max(1, Math.hypot(x, y));
      [x, y] = [x / size, y / size];
      knob.style.translate = `${(x * width) / 3}px ${(y * width) / 3}px`;
      this.stick = [Math.abs(y) > DEAD ? -y : 0, 0, Math.abs(x) > DEAD ? -x : 0];
    };
    const release = () => {
      knob.style.translate = "";
      this.stick = [0, 0, 0];
    };
    stick.addEventListener("pointerdown", (event) => {
      stick.setPointerCapture(event.pointerId);
      move(event);
    });
    stick.addEventListener("pointermove", (event) => { if (stick.hasPointerCapture(event.pointerId)) move(event); });
    stick.addEventListener("pointerup", release);
    stick.addEventListener("pointercancel", release);
  }
}
