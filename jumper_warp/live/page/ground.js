// Grounds of the scenes: boxes and a rough field, the same for physics and picture. Lengths in m.
const BOXES = { // center and half sizes along x and y, and height
  blocks: [
    { center: [0, 0], half: [0.5, 0.45], height: 0.12 },
    { center: [2.3, 0], half: [0.6, 0.6], height: 0.06 },
    { center: [0, 2.2], half: [0.6, 0.6], height: 0.04 },
    { center: [-2.2, -0.4], half: [0.6, 0.6], height: 0.08 },
    { center: [2.2, -2.2], half: [0.7, 0.5], height: 0.05 },
  ],
};
const CELLS = 161;
const HALF = 8;
const TOP = 0.06;
let field;

export const boxesOf = (scene) => BOXES[scene] ?? [];

// Return the rough field: heights relative to `top`, (cells, cells), rows along y; flat at its middle and its border.
export function rough() {
  if (field) return field;
  let seed = 7;
  const random = () => { seed = (seed * 16807) % 2147483647; return seed / 2147483647; };
  const waves = Array.from({ length: 24 }, () => {
    const angle = 2 * Math.PI * random();
    const length = 0.35 + 1.2 * random();
    return [(2 * Math.PI * Math.cos(angle)) / length, (2 * Math.PI * Math.sin(angle)) / length, 2 * Math.PI * random()];
  });
  const data = new Float32Array(CELLS * CELLS);
  const at = (index) => -HALF + (2 * HALF * index) / (CELLS - 1);
  for (let row = 0; row < CELLS; row++) {
    for (let column = 0; column < CELLS; column++) {
      const [x, y] = [at(column), at(row)];
      const sum = waves.reduce((total, [a, b, phase]) => total + Math.sin(a * x + b * y + phase), 0);
      const edge = Math.min(1, 2 * (HALF - Math.max(Math.abs(x), Math.abs(y))));
      const start = Math.min(1, Math.max(0, 2 * (Math.hypot(x, y) - 0.6)));
      data[row * CELLS + column] = Math.min(1, Math.max(0, 0.5 + 0.09 * sum)) * edge * start;
    }
  }
  field = { data, cells: CELLS, half: HALF, top: TOP };
  return field;
}

// Return the height of the ground of a scene at a place.
export function surface(scene, x, y) {
  let height = 0;
  for (const { center, half, height: top } of boxesOf(scene)) {
    if (Math.abs(x - center[0]) <= half[0] && Math.abs(y - center[1]) <= half[1]) height = Math.max(height, top);
  }
  if (scene === "rough" && Math.max(Math.abs(x), Math.abs(y)) < HALF) {
    const { data } = rough();
    const [u, v] = [x, y].map((value) => ((value + HALF) / (2 * HALF)) * (CELLS - 1));
    const [i, j] = [Math.min(Math.floor(u), CELLS - 2), Math.min(Math.floor(v), CELLS - 2)];
    const corner = (di, dj) => data[(j + dj) * CELLS + i + di];
    const low = corner(0, 0) * (1 - u + i) + corner(1, 0) * (u - i);
    const high = corner(0, 1) * (1 - u + i) + corner(1, 1) * (u - i);
    height = TOP * (low * (1 - v + j) + high * (v - j));
  }
  return height;
}
