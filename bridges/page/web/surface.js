// The skin as a surface that dents where it is pressed, with the contacts' forces as arrows. Drawn by three.js, which is
// fetched when the environment is made; without it, or without WebGL, there is no surface.

import { colour, lineColour } from "./colours.js";

const GRID = 72;
const DEPTH = 0.22; // of the skin's width: the dent of the drop that has the brightest colour
const ARROW = 0.05; // of the skin's width, for each newton
const TURN = 0.08;
const SLOW = /swiftshader|llvmpipe|software/i; // drawn by the processor
const EVERY_MS = 33, SLOW_EVERY_MS = 150;
const TINTS = Array.from({ length: 65 }, (_, k) => // of drops from 0 to 1; the bare skin is grey
  (k < 2 ? [84, 92, 110] : colour(0.15 + (0.85 * k) / 64)).map((v) => (v / 255) ** 2.2));

export class Surface {
  /** null where it cannot be drawn here. */
  static async on(root) {
    const probe = document.createElement("canvas").getContext("webgl2");
    if (!probe) return null;
    try {
      const three = await import("/three/three.module.min.js");
      return new Surface(root, three, probe);
    } catch (why) {
      console.info(`no surface: ${why.message}`);
      return null;
    }
  }

  constructor(root, three, probe) {
    this.root = root;
    this.three = three;
    const named = probe.getExtension("WEBGL_debug_renderer_info");
    this.slow = SLOW.test(named ? probe.getParameter(named.UNMASKED_RENDERER_WEBGL) : "");
    probe.getExtension("WEBGL_lose_context")?.loseContext();
    this.renderer = new three.WebGLRenderer({ antialias: !this.slow, alpha: true });
    this.renderer.debug.checkShaderErrors = false; // asking would wait for the compiler
    this.drawn = 0;
    root.append(this.renderer.domElement);
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(32, 1, 0.1, 20);
    this.turn = -0.5;
    this.tilt = 0.85;
    const plane = new three.PlaneGeometry(2, 2, GRID - 1, GRID - 1);
    plane.setAttribute("color", new three.BufferAttribute(new Float32Array(3 * GRID * GRID), 3));
    this.plane = plane;
    this.material = new three.MeshLambertMaterial({ vertexColors: true, side: three.DoubleSide });
    this.scene.add(new three.Mesh(plane, this.material));
    this.scene.add(new three.HemisphereLight(0xffffff, 0x556070, 1.6));
    const sun = new three.DirectionalLight(0xffffff, 2.2);
    sun.position.set(-1.5, 1.2, 2);
    this.scene.add(sun);
    this.arrows = new three.Group();
    this.rim = new three.Group();
    this.scene.add(this.arrows, this.rim);
    this.arrows.add(this.arrow());
    this.values = new Float32Array(GRID * GRID);
    this.dent(null, 0, 0, 1);
    this.hands();
    new ResizeObserver(() => this.resize()).observe(root);
    this.resize();
  }

  /** points, electrodes: places in metres. */
  geometry(points, electrodes) {
    const all = points.flat().map(Math.abs);
    this.half = Math.max(...all);
    const line = [...points, points[0]].map(([x, y]) => new this.three.Vector3(x / this.half, y / this.half, 0.004));
    const edge = new this.three.Line(new this.three.BufferGeometry().setFromPoints(line), new this.three.LineBasicMaterial({ color: 0x8a93a6 }));
    const ball = new this.three.SphereGeometry(0.035, 12, 8), skin = new this.three.MeshLambertMaterial({ color: 0x2f9e44 });
    const balls = [];
    for (let k = 0; k < electrodes.length / 2; k++) {
      const each = new this.three.Mesh(ball, skin);
      each.position.set(electrodes[2 * k] / this.half, electrodes[2 * k + 1] / this.half, 0);
      balls.push(each);
    }
    this.rim.clear();
    this.rim.add(edge, ...balls);
    this.dirty = true;
  }

  /** The drops (rows from the lowest y), `top` being the brightest colour; null: flat. */
  dent(values, rows, columns, top) {
    this.late = values && [values, rows, columns, top];
    if (values === null) this.bend(values, rows, columns, top);
    this.dirty = true;
  }

  bend(values, rows, columns, top) {
    const place = this.plane.attributes.position, tint = this.plane.attributes.color;
    const at = (row, column) => values[Math.min(rows - 1, Math.max(0, row)) * columns + Math.min(columns - 1, Math.max(0, column))];
    for (let i = 0; i < GRID; i++) { // from the highest y down, as the plane is made
      const row = Math.round(((GRID - 1 - i) * (rows - 1)) / (GRID - 1));
      for (let j = 0; j < GRID; j++) {
        const k = i * GRID + j, column = Math.round((j * (columns - 1)) / (GRID - 1));
        // A foam has no steps: each place is the mean of itself and its neighbours.
        const mean = values ? (2 * at(row, column) + at(row - 2, column) + at(row + 2, column) + at(row, column - 2) + at(row, column + 2)) / 6 : 0;
        const drop = Math.max(0, mean / top);
        place.setZ(k, -2 * DEPTH * drop);
        tint.setXYZ(k, ...TINTS[Math.min(64, Math.round(64 * drop))]);
      }
    }
    place.needsUpdate = tint.needsUpdate = true;
    this.plane.computeVertexNormals();
  }

  /** An arrow along each contact's normal, as long as its force. They are kept: making a shader anew takes long. */
  contacts(contacts) {
    if (!this.half) return;
    while (this.arrows.children.length < contacts.length) this.arrows.add(this.arrow());
    this.arrows.children.forEach((arrow, k) => {
      const c = contacts[k];
      if (arrow.visible || c) this.dirty = true;
      arrow.visible = c !== undefined;
      if (!c) return;
      const normal = new this.three.Vector3(...c.normal).normalize(), long = 0.15 + 2 * ARROW * (c.force_n ?? 1);
      arrow.position.set(c.position[0] / this.half, c.position[1] / this.half, 0.02);
      arrow.quaternion.setFromUnitVectors(new this.three.Vector3(0, 1, 0), normal);
      arrow.children[1].scale.y = long;
      for (const part of arrow.children) part.material.color.set(lineColour(c.id));
    });
  }

  /** Its tip at its origin, pointing down its y axis. */
  arrow() {
    const { Group, Mesh, MeshBasicMaterial, ConeGeometry, CylinderGeometry } = this.three;
    const found = new Group(), material = new MeshBasicMaterial();
    const head = new Mesh(new ConeGeometry(0.05, 0.12, 12).rotateX(Math.PI).translate(0, 0.06, 0), material);
    found.add(head, new Mesh(new CylinderGeometry(0.016, 0.016, 1, 8).translate(0, 0.5, 0), material));
    found.visible = false;
    return found;
  }

  hands() {
    let held = null;
    this.root.addEventListener("pointerdown", (event) => {
      held = [event.clientX, event.clientY];
      this.root.setPointerCapture(event.pointerId);
    });
    this.root.addEventListener("pointermove", (event) => {
      if (!held) return;
      this.look(0.01 * (event.clientX - held[0]), 0.01 * (event.clientY - held[1]));
      held = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) this.root.addEventListener(end, () => { held = null; });
    this.root.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] }[event.key];
      if (!way) return;
      event.preventDefault();
      this.look(...way);
    });
  }

  look(turn, tilt) {
    this.turn -= turn;
    this.tilt = Math.min(1.5, Math.max(0.15, this.tilt + tilt));
    this.dirty = true;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.root;
    if (!width || !height) return;
    this.renderer.setPixelRatio(this.slow ? 0.75 : Math.min(2, devicePixelRatio));
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.dirty = true;
  }

  /** Draw what has changed, not more often than the machine can. */
  draw(nowMs) {
    if (!this.dirty || nowMs - this.drawn < (this.slow ? SLOW_EVERY_MS : EVERY_MS)) return;
    this.drawn = nowMs;
    this.dirty = false;
    if (this.late) this.bend(...this.late);
    this.late = null;
    const far = 5.2 / Math.min(1, this.camera.aspect), flat = Math.cos(this.tilt) * far;
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(flat * Math.sin(this.turn), -flat * Math.cos(this.turn), Math.sin(this.tilt) * far);
    this.camera.lookAt(0, 0, 0);
    this.renderer.render(this.scene, this.camera);
  }
}
