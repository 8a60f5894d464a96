// Draws a scene (plan.js) in space with three.js: z is up, lengths are in m.
// One renderer draws for all canvases of the page, because browsers allow only a few WebGL contexts.

const TALL = 0.4; // m, of obstacles in the plane, as in the simulator
const LOW = 0.02; // m, of marks on the floor

/** The page's WebGL renderer, or null: this browser has none. */
const renderer = (() => {
  let made;
  return () => {
    if (made === undefined) {
      try {
        const canvas = document.createElement("canvas");
        const context = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
        made = context ? new THREE.WebGLRenderer({ canvas, context, antialias: true, preserveDrawingBuffer: true }) : null;
      } catch {
        made = null;
      }
    }
    return made;
  };
})();

const SHAPES = {
  box: new THREE.BoxGeometry(1, 1, 1),
  cylinder: new THREE.CylinderGeometry(1, 1, 1, 28).rotateX(Math.PI / 2),
  ball: new THREE.SphereGeometry(1, 24, 16),
  cone: new THREE.ConeGeometry(1, 1, 16).rotateX(Math.PI / 2),
  plane: new THREE.PlaneGeometry(1, 1),
  edges: new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1)),
};
const SHARED = new Set(Object.values(SHAPES));
const dark = matchMedia("(prefers-color-scheme: dark)");

/** The value of a color of colors.css. */
const paint = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const NAMES = { l: "allowed", d: "adjusted", a: "failsafe", e: "recovering", n: "unfiltered" };

function material(name, opacity = 1, look = {}) {
  const see = opacity < 1 ? { transparent: true, opacity, depthWrite: false } : {};
  return new THREE.MeshLambertMaterial({ color: paint(name), ...see, ...look });
}

/** Add a mesh of a shape, scaled to `size` around `at`. */
function solid(group, shape, at, size, look, yaw = 0) {
  const mesh = new THREE.Mesh(SHAPES[shape], look);
  mesh.position.set(at[0], at[1], at[2]);
  mesh.scale.set(...size);
  mesh.rotation.z = yaw;
  group.add(mesh);
  return mesh;
}

function line(group, points, name, { opacity = 1, loop = false } = {}) {
  const geometry = new THREE.BufferGeometry().setFromPoints(points.map((p) => new THREE.Vector3(...p)));
  const look = new THREE.LineBasicMaterial({ color: paint(name), transparent: opacity < 1, opacity });
  group.add(loop ? new THREE.LineLoop(geometry, look) : new THREE.Line(geometry, look));
}

/** The edges of a box. */
function frame(group, at, size, name, opacity = 1) {
  const edges = new THREE.LineSegments(SHAPES.edges, new THREE.LineBasicMaterial({ color: paint(name), transparent: true, opacity }));
  edges.position.set(...at);
  edges.scale.set(...size);
  group.add(edges);
}

/** Free the geometries and materials of a group, and empty it. */
function clear(group) {
  group.traverse((item) => {
    if (item.geometry && !SHARED.has(item.geometry)) item.geometry.dispose();
    item.material?.dispose();
    item.dispose?.();
  });
  group.clear();
}

/** A disc on the floor in the plane (x, y, radius), a ball in space (x, y, z, radius). */
function round(group, row, look, tall = LOW, floor = 0) {
  const radius = row.at(-1);
  if (row.length > 3) return solid(group, "ball", row, [radius, radius, radius], look);
  return solid(group, "cylinder", [row[0], row[1], floor + tall / 2], [radius, radius, tall], look);
}

function addObstacle(group, { kind, at, size, yaw = 0 }, look) {
  const flat = at.length === 2, [x, y] = at, z = flat ? TALL / 2 : at[2];
  if (kind === "box") solid(group, "box", [x, y, z], [size[0], size[1], size[2] ?? TALL], look, yaw);
  else if (kind === "cylinder" || (kind === "sphere" && flat)) solid(group, "cylinder", [x, y, z], [size[0], size[0], size[1] ?? TALL], look);
  else if (kind === "sphere") solid(group, "ball", at, [size[0], size[0], size[0]], look);
}

/** What stays during an episode: floor, room, obstacles, goal and start. */
function addArena(group, scene, reach) {
  const flat = !scene.z, low = scene.floor ?? 0, high = scene.ceiling ?? (flat ? TALL : low + reach);
  const edge = 2 * reach, lift = (z) => (flat ? z : low);
  const ground = solid(group, "plane", [0, 0, low - 0.002 * reach], [edge, edge, 1], material("field", 1, { side: THREE.DoubleSide }));
  ground.renderOrder = -2;
  const grid = new THREE.GridHelper(edge, Math.max(2, 2 * Math.round(reach)), paint("axis"), paint("line"));
  grid.rotation.x = Math.PI / 2;
  grid.position.z = low;
  group.add(grid);
  if (scene.half) {
    solid(group, "box", [0, 0, (low + high) / 2], [edge, edge, high - low], material("wall", 0.12, { side: THREE.BackSide })).renderOrder = -1;
    frame(group, [0, 0, (low + high) / 2], [edge, edge, high - low], "wall", 0.6);
  }
  const look = material("obstacle");
  for (const obstacle of scene.obstacles) addObstacle(group, obstacle, look);
  if (scene.goal) round(group, [...scene.goal, scene.goal_radius], material("goal", 0.4), LOW, lift(0));
  if (scene.start) round(group, [...scene.start, 0.012 * reach], material("ink"), LOW, lift(0));
}

/** Cylinders along the path up to the point `last`, and balls at its interventions, in the colors of the decisions. */
function addPath(group, scene, last, thick) {
  const at = (k) => new THREE.Vector3(scene.points[k][0], scene.points[k][1], scene.points[k][2] ?? thick);
  const balls = [...scene.kinds.slice(0, last + 1)].flatMap((kind, k) => (INTERVENTIONS.includes(kind) ? [k] : []));
  const pieces = new THREE.InstancedMesh(SHAPES.cylinder, new THREE.MeshLambertMaterial(), Math.max(1, last));
  const marks = new THREE.InstancedMesh(SHAPES.ball, new THREE.MeshLambertMaterial(), Math.max(1, balls.length));
  const colors = Object.fromEntries(Object.entries(NAMES).map(([letter, name]) => [letter, new THREE.Color(paint(name))]));
  const up = new THREE.Vector3(0, 0, 1), matrix = new THREE.Matrix4(), turn = new THREE.Quaternion();
  for (let k = 1; k <= last; k++) {
    const [from, to] = [at(k - 1), at(k)], way = to.clone().sub(from), length = way.length();
    turn.setFromUnitVectors(up, length > 1e-9 ? way.clone().divideScalar(length) : up);
    pieces.setMatrixAt(k - 1, matrix.compose(from.add(to).multiplyScalar(0.5), turn, new THREE.Vector3(thick, thick, length)));
    pieces.setColorAt(k - 1, colors[scene.kinds[k]]);
  }
  balls.forEach((k, i) => {
    const size = (scene.kinds[k] === "a" ? 2.4 : 1.8) * thick;
    marks.setMatrixAt(i, matrix.compose(at(k), turn.identity(), new THREE.Vector3(size, size, size)));
    marks.setColorAt(i, colors[scene.kinds[k]]);
  });
  [pieces.count, marks.count] = [last, balls.length];
  for (const mesh of [pieces, marks]) {
    mesh.frustumCulled = false;
    group.add(mesh);
  }
  if (last < scene.points.length - 1) line(group, scene.points.slice(last).map(([x, y, z]) => [x, y, z ?? thick]), "soft", { opacity: 0.5 });
}

/** The body's discs or balls at its pose, with a nose if it has a heading. */
function addBody(group, scene, thick) {
  const [x, y, heading, z] = scene.pose, flat = !scene.z, cos = Math.cos(heading ?? 0), sin = Math.sin(heading ?? 0);
  const tall = Math.min(0.2, 1.5 * (scene.footprint || 0.1)), look = material("body", 0.75, { depthWrite: true });
  for (const row of scene.discs?.length ? scene.discs : [[0, 0, 2 * thick]]) {
    const place = [x + row[0] * cos - row[1] * sin, y + row[0] * sin + row[1] * cos];
    round(group, flat ? [...place, row.at(-1)] : [...place, z + (row.length > 3 ? row[2] : 0), row.at(-1)], look, tall);
  }
  if (heading !== null && flat) {
    const reach = 0.55 * scene.footprint;
    solid(group, "box", [x + reach * cos, y + reach * sin, tall + LOW], [2 * reach, 0.2 * scene.footprint, LOW], material("ink"), heading);
  }
}

/** A row with its center and half-widths (2d) as a box. */
function addBox(group, row, name, opacity, more = 0) {
  const d = row.length / 2, at = [row[0], row[1], d > 2 ? row[2] : LOW];
  const size = [0, 1, 2].map((i) => (i < d ? 2 * (row[d + i] + more) : LOW));
  solid(group, "box", at, size, material(name, opacity));
  frame(group, at, size, name, Math.min(1, 3 * opacity));
}

function addArrow(group, from, way, name, thick) {
  const start = new THREE.Vector3(from[0], from[1], from[2] ?? TALL / 2), ahead = new THREE.Vector3(way[0], way[1], way[2] ?? 0), length = ahead.length();
  if (length < 1e-6) return;
  const head = Math.min(0.4 * length, 6 * thick), look = material(name), up = new THREE.Vector3(0, 0, 1);
  const part = (shape, from, size) => {
    const mesh = solid(group, shape, start.clone().addScaledVector(ahead, from / length).toArray(), size, look);
    mesh.quaternion.setFromUnitVectors(up, ahead.clone().divideScalar(length));
  };
  part("cylinder", (length - head) / 2, [thick, thick, length - head]);
  part("cone", length - head / 2, [2.5 * thick, 2.5 * thick, head]);
}

/** The edge of the half-space that blocks the proposal. */
function addEdge(group, edge, size) {
  const d = edge.length / 2, at = [edge[0], edge[1], d > 2 ? edge[2] : TALL / 2];
  const mesh = solid(group, "plane", at, [size, d > 2 ? size : TALL, 1], material("halfspace", 0.35, { side: THREE.DoubleSide }));
  mesh.up.set(0, 0, 1);
  mesh.lookAt(at[0] + edge[d], at[1] + edge[d + 1], at[2] + (d > 2 ? edge[d + 2] : 0));
}

/** The decision at the pose: tube, plan, arrows, half-space, and what the robot perceives. */
function addDecision(group, scene, thick) {
  const { movers = [], swept = [], free = [], hits = [], reservations = [], boxes = [], from, arrows = [], edge } = { movers: scene.movers, ...scene.decision };
  const lift = (points) => points.map(([x, y, z]) => [x, y, z ?? LOW]);
  for (const mover of movers ?? []) round(group, mover, material("mover"), TALL);
  for (const reach of swept.flat()) round(group, reach, material("mover", 0.06));
  for (const reserved of reservations) addBox(group, reserved, "reserved", 0.12);
  if (free.length) line(group, lift(free), "free", { loop: true });
  if (hits.length) {
    const geometry = new THREE.BufferGeometry().setFromPoints(lift(hits).map((p) => new THREE.Vector3(...p)));
    group.add(new THREE.Points(geometry, new THREE.PointsMaterial({ color: paint("hit"), size: 4, sizeAttenuation: false })));
  }
  if (!boxes.length) return;
  for (const row of boxes) addBox(group, row, "tube", 0.22);
  line(group, lift([from, ...boxes]), "plan");
  if (edge?.length) addEdge(group, edge, 5 * scene.footprint);
  arrows.forEach((way, i) => addArrow(group, from, way, ["proposed", "executed"][i], thick));
}

/** A canvas that shows scenes in space, and its camera. `canvas` has a size by its style. */
class Space {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.world = new THREE.Scene();
    this.arena = new THREE.Group();
    this.moment = new THREE.Group();
    const sun = new THREE.DirectionalLight(0xffffff, 2);
    sun.position.set(2, -3, 5);
    this.world.add(this.arena, this.moment, new THREE.AmbientLight(0xffffff, 1.6), sun);
    this.camera = new THREE.PerspectiveCamera(40, 4 / 3, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    canvas.style.touchAction = "pan-y"; // a finger that moves up or down scrolls the page
    this.controls.enableZoom = false; // the wheel scrolls the page until the canvas has the focus
    canvas.addEventListener("focus", () => { this.controls.enableZoom = true; });
    canvas.addEventListener("blur", () => { this.controls.enableZoom = false; });
    canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
    this.controls.addEventListener("change", () => this.request());
    dark.addEventListener("change", () => { this.shown = null; if (this.scene) this.show(this.scene, this.last, this.key); });
    new ResizeObserver(() => this.request()).observe(canvas);
  }

  /** Show a scene; its path is bold up to the point `last`. Scenes of the same `key` share their arena and the camera. */
  show(scene, last, key) {
    const reach = scene.half ?? Math.max(1, ...sceneBounds(scene).map(Math.abs));
    const thick = Math.max(0.004 * reach, Math.min(0.008 * reach, 0.1 * (scene.footprint || 1)));
    if (this.shown !== key) {
      clear(this.arena);
      addArena(this.arena, scene, reach);
      if (this.key !== key) this.home(scene, reach);
      this.shown = this.key = key;
    }
    [this.scene, this.last] = [scene, last];
    clear(this.moment);
    addPath(this.moment, scene, last, thick);
    addBody(this.moment, scene, thick);
    addDecision(this.moment, scene, thick);
    if (this.following) this.follow(scene);
    this.request();
  }

  /** Look at the whole arena from the south-west. */
  home(scene = this.scene, reach = scene.half ?? Math.max(1, ...sceneBounds(scene).map(Math.abs))) {
    const low = scene.floor ?? 0, high = scene.ceiling ?? (scene.z ? low + reach : 0);
    const middle = (low + high) / 2, radius = Math.hypot(reach, reach, (high - low) / 2);
    const away = (0.96 * radius) / Math.sin((0.5 * this.camera.fov * Math.PI) / 180);
    this.controls.target.set(0, 0, middle);
    this.camera.position.set(-0.4, -0.68, 0.61).multiplyScalar(away).add(this.controls.target);
    this.camera.near = 0.005 * reach;
    this.camera.far = 20 * reach;
    this.camera.updateProjectionMatrix();
    this.following = false;
    this.controls.update();
    this.request();
  }

  /** Keep the robot in the middle; come close to it at first. */
  follow(scene = this.scene) {
    const [x, y, , z] = scene.pose, target = new THREE.Vector3(x, y, z ?? 0), near = 14 * (scene.footprint || 0.1);
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (!this.following) offset.setLength(near);
    this.following = true;
    this.controls.target.copy(target);
    this.camera.position.copy(target).add(offset);
    this.controls.update();
    this.request();
  }

  /** Turn the camera about the vertical and tilt it [rad], or come closer by a factor. */
  orbit(turn, tilt, closer = 1) {
    const offset = this.camera.position.clone().sub(this.controls.target), flat = Math.hypot(offset.x, offset.y), far = offset.length() * closer;
    const angle = Math.atan2(offset.y, offset.x) + turn, up = Math.min(1.55, Math.max(0.02, Math.atan2(offset.z, flat) + tilt));
    this.camera.position.set(far * Math.cos(up) * Math.cos(angle), far * Math.cos(up) * Math.sin(angle), far * Math.sin(up)).add(this.controls.target);
    this.controls.update();
    this.request();
  }

  /** Render with the next frame of the browser. */
  request() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.render(); });
  }

  render() {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = Math.min(2, devicePixelRatio);
    if (!width || !this.scene) return;
    const gl = renderer();
    [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    gl.setSize(this.canvas.width, this.canvas.height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    gl.setClearColor(paint("paper"));
    gl.render(this.world, this.camera);
    this.pen.drawImage(gl.domElement, 0, 0);
    this.canvas.dataset.frames = String(+(this.canvas.dataset.frames ?? 0) + 1);
  }
}
