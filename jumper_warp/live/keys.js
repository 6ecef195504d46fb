// Keys held and gamepad of a visitor, sent as the value of the text field with the label LABEL.
// viser reports neither the release of a key nor gamepads. This file runs in the page of viser.
if (!window.jumperKeys) {
  window.jumperKeys = new Set();
  let sent = "";
  const field = () => {
    const labels = [...document.querySelectorAll("label, p, div")].filter((e) => e.textContent === LABEL);
    return labels.length ? labels[labels.length - 1].closest(".mantine-Flex-root")?.querySelector("input") : null;
  };
  const write = (text) => {
    const input = text !== sent ? field() : null;
    if (!input) return;
    sent = text;
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(input, text);
    input.dispatchEvent(new Event("input", { bubbles: true }));
  };
  const pad = () => {
    const pad = [...navigator.getGamepads()].find((each) => each);
    if (!pad) return "";
    const axes = [-pad.axes[1], -pad.axes[0], -(pad.axes[2] ?? 0)].map((x) => (Math.abs(x) < 0.15 ? 0 : x));
    const jump = pad.buttons[0]?.pressed;
    return jump || axes.some((x) => x) ? "pad " + axes.map((x) => x.toFixed(1)).join(" ") + (jump ? " jump" : "") : "";
  };
  const update = () => write([...window.jumperKeys].sort().join(" ") || pad());
  const typing = (event) => /INPUT|TEXTAREA/.test(event.target.tagName) && event.target.type !== "checkbox";
  window.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    if (!KEYS.includes(key) || typing(event) || event.ctrlKey || event.metaKey || event.altKey) return;
    window.jumperKeys.add(key);
    update();
  });
  window.addEventListener("keyup", (event) => {
    window.jumperKeys.delete(event.key.toLowerCase());
    update();
  });
  window.addEventListener("blur", () => {
    window.jumperKeys.clear();
    update();
  });
  setInterval(update, 50);
}
