// The picture: robot, ground, goals, and the ghost of the last jump, drawn by three.js. World z is up.
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { mergeGeometries, mergeVertices } from "three/examples/jsm/utils/BufferGeometryUtils.js";
import { boxesOf, rough, surface } from "./ground.js";

const [SPHERE, CYLINDER, BOX, MESH] = [2, 5, 6, 7]; // MuJoCo's types of geoms
const GREEN = 0x22c55e;
const RED = 0xef4444;
const COLORS = {
  light: { sky: 0xdfe7ee, ground: ["#c9d1d6", "#b9c2c8"], box: 0xd8a15c, ambient: 1.5 },
  dark: { sky: 0x11161c, ground: ["#3a4147", "#30363b"], box: 0x9a6a35, ambient: 0.9 },
  mars: { sky: 0xe3b48f, ground: ["#b5673f", "#a65b36"], box: 0x8a4a2c, ambient: 1.2 },
  marsDark: { sky: 0x2a1710, ground: ["#6b3a23", "#5f321e"], box: 0x8a4a2c, ambient: 0.8 },
};
const SLOW = 28; // [ms] time of a frame above which the resolution falls
const LAG = 150; // [ms] of the camera behind a rising robot
const LEAST = 0.4; // pixels a CSS pixel of the lowest resolution

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    const slow = withoutGpu();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !slow });
    this.renderer.shadowMap.enabled = true;
    this.ratio = slow ? 0.6 : Math.min(window.devicePixelRatio, 2);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 80);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-2.1, -2.3, 1.35);
    this.orbit = new OrbitControls(this.camera, canvas);
    Object.assign(this.orbit, { enablePan: false, minDistance: 1, maxDistance: 12, maxPolarAngle: 1.52, enableDamping: true });
    this.orbit.target.set(0, 0, 0.35);
    this.orbit.saveState();
    this.ambient = new THREE.HemisphereLight(0xffffff, 0x8a8f94, 1.5);
    this.sun = new THREE.DirectionalLight(0xffffff, 2.4);
    this.sun.castShadow = true;
    this.sun.position.set(-1.5, 2, 6);
    this.sun.shadow.mapSize.setScalar(slow ? 512 : 1024);
    this.sun.shadow.radius = 5;
    this.sun.shadow.normalBias = 0.02;
    Object.assign(this.sun.shadow.camera, { left: -2, right: 2, top: 2, bottom: -2, near: 0.5, far: 14 });
    this.ground = new THREE.Group();
    this.goal = ring(0.16, 0.2);
    this.hover = ring(0.16, 0.2);
    this.path = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0xf97316 }));
    this.path.frustumCulled = false;
    this.scene.add(this.ambient, this.sun, this.sun.target, this.ground, this.goal, this.hover, this.path);
    this.ray = new THREE.Raycaster();
    this.position = new THREE.Vector3(0, 0, 0.4);
    this.states = [];
    this.frames = [];
    this.lastFrame = 0;
    this.resize();
  }

  // Draw a robot, the same in all scenes; shapes: see `Robot.shapes`.
  setRobot(shapes) {
    if (this.robot) return;
    const geometry = mergeGeometries(shapes.map(geometryOf));
    const count = Math.max(...shapes.map((shape) => shape.body)) + 1;
    this.robot = skinned(geometry, new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.55, metalness: 0.15 }), count);
    this.robot.castShadow = true;
    this.robot.receiveShadow = true;
    this.ghost = skinned(geometry, new THREE.MeshBasicMaterial({ color: 0xf97316, transparent: true, opacity: 0.3 }), count);
    const depth = new THREE.SkinnedMesh(geometry, new THREE.MeshBasicMaterial({ colorWrite: false })); // nearest faces only
    depth.bind(this.ghost.skeleton, new THREE.Matrix4());
    Object.assign(depth, { frustumCulled: false, renderOrder: 1 });
    Object.assign(this.ghost, { visible: false, renderOrder: 2 });
    this.ghost.add(depth);
    this.scene.add(this.robot, this.ghost);
  }

  // Draw the ground of a scene; dark: colours.
  setGround(name, dark) {
    this.name = name;
    const mars = name === "mars";
    const colors = COLORS[mars ? (dark ? "marsDark" : "mars") : dark ? "dark" : "light"];
    this.scene.background = new THREE.Color(colors.sky);
    this.scene.fog = new THREE.Fog(colors.sky, 9, 26);
    this.ambient.intensity = colors.ambient;
    for (const child of this.ground.children) child.geometry.dispose();
    this.ground.clear();
    const texture = checker(colors.ground);
    const material = new THREE.MeshStandardMaterial({ map: texture, roughness: 0.95 });
    const plane = new THREE.Mesh(new THREE.PlaneGeometry(80, 80), material);
    this.ground.add(plane);
    this.plane = plane;
    if (name === "rough") this.ground.add(fieldMesh(material));
    const box = new THREE.MeshStandardMaterial({ color: colors.box, roughness: 0.8 });
    for (const { center, half, height } of boxesOf(name)) {
      const mesh = new THREE.Mesh(new THREE.BoxGeometry(2 * half[0], 2 * half[1], height), box);
      mesh.position.set(...center, height / 2);
      mesh.castShadow = true;
      this.ground.add(mesh);
    }
    for (const child of this.ground.children) child.receiveShadow = true;
    this.showJump(null);
  }

  // Take the poses of all bodies after a policy step; period [ms]: until the next one.
  update(poses, period) {
    this.states = [this.states[1] ?? { poses }, { poses, time: performance.now(), period }];
  }

  // Show the pose at the apex of the last jump and the path of its base; null: nothing.
  showJump(jump) {
    if (!this.ghost) return;
    this.ghost.visible = Boolean(jump?.poses);
    if (jump?.poses) pose(this.ghost, jump.poses);
    this.path.geometry.dispose();
    this.path.geometry = new THREE.BufferGeometry();
    this.path.geometry.setAttribute("position", new THREE.BufferAttribute(jump?.path ?? new Float32Array(0), 3));
  }

  // Mark the place x, y of a jump, and whether it is within reach; null: none. mark: "goal" or "hover".
  mark(mark, place, good) {
    this[mark].visible = place !== null;
    if (!place) return;
    this[mark].position.set(place[0], place[1], surface(this.name, ...place) + 0.006);
    this[mark].material.color.set(good ? GREEN : RED);
  }

  // Aim the ray at a point of the window.
  aim(x, y) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    this.ray.setFromCamera(new THREE.Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height), this.camera);
  }

  // Return the place x, y of the ground at a point of the window, or null.
  place(x, y) {
    this.aim(x, y);
    const hit = this.ray.intersectObjects(this.ground.children)[0];
    return hit && hit.distance < 25 ? [hit.point.x, hit.point.y] : null;
  }

  onRobot(x, y) {
    this.aim(x, y);
    return this.ray.ray.distanceToPoint(this.position) < 0.2;
  }

  // Return the point at a point of the window, as far away as the robot.
  besideRobot(x, y) {
    this.aim(x, y);
    const normal = this.camera.getWorldDirection(new THREE.Vector3());
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(normal, this.position);
    const point = this.ray.ray.intersectPlane(plane, new THREE.Vector3());
    return point ? [point.x, point.y, Math.max(point.z, 0.1)] : null;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.fov = width < height ? 58 : 40;
    this.camera.updateProjectionMatrix();
  }

  // Put the camera to where it is at the start; the next frame moves it to the robot.
  resetView() {
    this.orbit.reset();
    this.position.set(0, 0, 0.4);
  }

  // Draw a frame between the last two policy steps; the camera follows the robot.
  draw(now) {
    const [before, after] = this.states;
    if (this.robot && after) {
      const share = Math.min(1, (now - after.time) / after.period);
      pose(this.robot, after.poses, before.poses, share);
      const base = this.robot.skeleton.bones[1].position;
      const shift = new THREE.Vector3(base.x - this.position.x, base.y - this.position.y, 0);
      this.camera.position.add(shift);
      this.orbit.target.add(shift);
      const rise = (1 - Math.exp((this.lastFrame - now) / LAG)) * (Math.max(0.35, base.z - 0.2) - this.orbit.target.z);
      this.orbit.target.z += rise;
      this.camera.position.z += rise;
      this.position.copy(base);
      this.sun.target.position.set(base.x, base.y, 0);
      this.sun.position.set(base.x - 1.5, base.y + 2, 6);
      this.plane.position.set(Math.round(base.x), Math.round(base.y), 0);
    }
    this.orbit.update();
    this.renderer.render(this.scene, this.camera);
    this.adapt(now);
  }

  // Lower the resolution, and then the shadow, if frames take long.
  adapt(now) {
    this.frames.push(now - this.lastFrame);
    this.lastFrame = now;
    if (this.frames.length < 12) return;
    const median = this.frames.sort((a, b) => a - b)[6];
    this.frames = [];
    if (median < SLOW) return;
    if (this.ratio > LEAST) {
      this.ratio = Math.max(LEAST, this.ratio * Math.min(0.8, Math.sqrt(20 / median)));
      this.resize();
    } else this.sun.castShadow = false;
  }
}

// Return whether the browser draws without a GPU.
function withoutGpu() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  return !info || /swiftshader|llvmpipe|software/i.test(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
}

function ring(inner, outer) {
  const material = new THREE.MeshBasicMaterial({ color: GREEN, transparent: true, opacity: 0.9, depthWrite: false });
  const mesh = new THREE.Mesh(new THREE.RingGeometry(inner, outer, 48), material);
  mesh.visible = false;
  return mesh;
}

function checker([first, second]) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 128;
  const context = canvas.getContext("2d");
  for (let i = 0; i < 4; i++) {
    context.fillStyle = (i % 2) ^ (i >> 1) ? first : second;
    context.fillRect(64 * (i % 2), 64 * (i >> 1), 64, 64);
  }
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(80, 80); // cells of 0.5 m on a plane of 80 m
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.anisotropy = 8;
  return texture;
}

function fieldMesh(material) {
  const { data, cells, half, top } = rough();
  const geometry = new THREE.PlaneGeometry(2 * half, 2 * half, cells - 1, cells - 1);
  const { position, uv } = geometry.attributes;
  for (let row = 0; row < cells; row++) {
    for (let column = 0; column < cells; column++) {
      const index = (cells - 1 - row) * cells + column; // rows of three.js go down
      position.setZ(index, top * data[row * cells + column] + 0.003);
    }
  }
  for (let i = 0; i < uv.count; i++) uv.setXY(i, (position.getX(i) + 40) / 80, (position.getY(i) + 40) / 80);
  geometry.computeVertexNormals();
  return new THREE.Mesh(geometry, material);
}

function geometryOf({ type, size, color, body, pos, quat: [w, x, y, z], vertices, faces }) {
  let geometry;
  if (type === MESH) {
    geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(vertices, 3));
    geometry.setIndex(Array.from(faces));
  } else if (type === CYLINDER) geometry = new THREE.CylinderGeometry(size[0], size[0], 2 * size[1], 28).rotateX(Math.PI / 2);
  else if (type === BOX) geometry = new THREE.BoxGeometry(...size.map((half) => 2 * half));
  else if (type === SPHERE) geometry = new THREE.SphereGeometry(size[0], 20, 14);
  geometry.deleteAttribute("uv");
  if (type === MESH) { // flat faces
    geometry = geometry.toNonIndexed();
    geometry.computeVertexNormals();
    geometry = mergeVertices(geometry);
  }
  geometry.applyQuaternion(new THREE.Quaternion(x, y, z, w)).translate(...pos);
  const count = geometry.attributes.position.count;
  const rgb = new THREE.Color().setRGB(...color.slice(0, 3), THREE.SRGBColorSpace);
  const fill = (Type, values) => Type.from({ length: values.length * count }, (_, i) => values[i % values.length]);
  geometry.setAttribute("color", new THREE.BufferAttribute(fill(Float32Array, rgb.toArray()), 3));
  geometry.setAttribute("skinIndex", new THREE.BufferAttribute(fill(Uint16Array, [body, 0, 0, 0]), 4));
  geometry.setAttribute("skinWeight", new THREE.BufferAttribute(fill(Float32Array, [1, 0, 0, 0]), 4));
  return geometry;
}

// Return one mesh for all bodies, each a bone, so that a robot is one draw call.
function skinned(geometry, material, count) {
  const mesh = new THREE.SkinnedMesh(geometry, material);
  const bones = Array.from({ length: count }, () => new THREE.Bone());
  mesh.add(...bones);
  mesh.bind(new THREE.Skeleton(bones, bones.map(() => new THREE.Matrix4())), new THREE.Matrix4());
  mesh.frustumCulled = false;
  return mesh;
}

// Put the bodies of a mesh between two arrays of poses, 7 values each: position and quaternion wxyz.
function pose(mesh, poses, before = poses, share = 1) {
  const mix = (index, sign = 1) => before[index] * (1 - share) * sign + poses[index] * share;
  mesh.skeleton.bones.forEach((bone, body) => {
    const at = 7 * body;
    bone.position.set(mix(at), mix(at + 1), mix(at + 2));
    const dot = [3, 4, 5, 6].reduce((sum, i) => sum + before[at + i] * poses[at + i], 0);
    const [w, x, y, z] = [3, 4, 5, 6].map((i) => mix(at + i, dot < 0 ? -1 : 1));
    bone.quaternion.set(x, y, z, w).normalize();
  });
}
