// Bundle the page to dist/: `node build.mjs`.
import fs from "node:fs";
import { build } from "esbuild";

const here = new URL(".", import.meta.url);
const dist = new URL("dist/", here);
fs.rmSync(dist, { recursive: true, force: true });
await build({
  absWorkingDir: here.pathname, entryPoints: ["app.js", "physics.js"], outdir: "dist", bundle: true, minify: true, format: "esm",
  target: "es2022", external: ["module", "node:*", "fs", "path", "url", "worker_threads"], legalComments: "linked", logLevel: "warning",
});
for (const file of ["index.html", "style.css"]) fs.copyFileSync(new URL(file, here), new URL(file, dist));
fs.copyFileSync(new URL("node_modules/@mujoco/mujoco/mujoco.wasm", here), new URL("mujoco.wasm", dist));
