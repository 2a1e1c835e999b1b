// The surface's meshes: triangles of vertices of six numbers, place and normal.

class Mesh {
  constructor() { Object.assign(this, { vertices: [], triangles: [], known: new Map() }); }

  /** Its number; the same for the same one again. */
  vertex(...six) {
    const name = six.map((v) => Math.round(v * 1e5)).join();
    if (!this.known.has(name)) {
      this.known.set(name, this.known.size);
      this.vertices.push(...six);
    }
    return this.known.get(name);
  }

  /** corners: numbers of vertices, in order. */
  polygon(corners) {
    for (let k = 2; k < corners.length; k++) this.triangles.push(corners[0], corners[k - 1], corners[k]);
  }
}

/** The part of a polygon on one side of a line across `axis`. */
function cut(polygon, axis, limit, sign) {
  const kept = [];
  polygon.forEach((p, k) => {
    const q = polygon[(k + 1) % polygon.length], a = sign * (p[axis] - limit), b = sign * (q[axis] - limit);
    if (a >= 0) kept.push(p);
    if (a < 0 !== b < 0) kept.push([0, 1].map((c) => p[c] + (a / (a - b)) * (q[c] - p[c])));
  });
  return kept;
}

const between = (polygon, axis, low, high) => cut(cut(polygon, axis, low, 1), axis, high, -1);

/** A sheet of this outline [(x, y) each in -1..1]: its face of cells of this side, with no normal, and walls down to z = -1. */
export function sheet(outline, side) {
  const found = new Mesh();
  for (let x = -1; x < 1; x += side) {
    const strip = between(outline, 0, x, x + side);
    for (let y = -1; strip.length && y < 1; y += side) {
      found.polygon(between(strip, 1, y, y + side).map((p) => found.vertex(...p, 0, 0, 0, 0)));
    }
  }
  const next = (k) => outline[(k + 1) % outline.length];
  const way = Math.sign(outline.reduce((sum, [x, y], k) => sum + x * next(k)[1] - next(k)[0] * y, 0));
  outline.forEach((p, k) => {
    const q = next(k), [dx, dy] = [q[0] - p[0], q[1] - p[1]], long = Math.hypot(dx, dy) || 1;
    const normal = [(way * dy) / long, (-way * dx) / long, 0], pieces = Math.ceil(long / side);
    const at = (n, z) => found.vertex(p[0] + (n / pieces) * dx, p[1] + (n / pieces) * dy, z, ...normal);
    for (let n = 0; n < pieces; n++) found.polygon([at(n, 0), at(n + 1, 0), at(n + 1, -1), at(n, -1)]);
  });
  return found;
}

/** A body of revolution round z. profile: pieces [[r, z], [r, z], ...], each smooth along itself. */
function turned(profile, steps = 14) {
  const found = new Mesh();
  for (const piece of profile) {
    const normals = piece.map((_, k) => {
      const [r0, z0] = piece[Math.max(0, k - 1)], [r1, z1] = piece[Math.min(piece.length - 1, k + 1)], long = Math.hypot(r1 - r0, z1 - z0);
      return [(z1 - z0) / long, (r0 - r1) / long];
    });
    const at = (k, step) => {
      const angle = (2 * Math.PI * (step % steps)) / steps, [x, y] = [Math.cos(angle), Math.sin(angle)];
      return found.vertex(piece[k][0] * x, piece[k][0] * y, piece[k][1], normals[k][0] * x, normals[k][0] * y, normals[k][1]);
    };
    for (let k = 1; k < piece.length; k++) {
      for (let n = 0; n < steps; n++) found.polygon([at(k - 1, n), at(k - 1, n + 1), at(k, n + 1), at(k, n)]);
    }
  }
  return found;
}

const arc = (from, to, count = 5) => Array.from({ length: count }, (_, k) => {
  const angle = from + ((to - from) * k) / (count - 1);
  return [Math.cos(angle), Math.sin(angle)];
});

/** From z = -1 to a round end above z = 0, of radius 1. */
export const pin = () => turned([[[1, -1], [1, 0]], arc(0, Math.PI / 2).map(([r, z]) => [r, 0.6 * z])]);
/** Tip at the origin, base at z = 1. */
export const cone = () => turned([[[0, 0], [1, 1]], [[1, 1], [0, 1]]]);
/** From z = 0 to z = 1. */
export const rod = () => turned([[[1, 0], [1, 1]], [[1, 1], [0, 1]]]);
/** A square from -1 to 1 at z = 0. */
export function square() {
  const found = new Mesh();
  found.polygon([[-1, -1], [1, -1], [1, 1], [-1, 1]].map((p) => found.vertex(...p, 0, 0, 0, 1)));
  return found;
}
