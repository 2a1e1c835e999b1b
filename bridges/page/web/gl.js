// As much of WebGL 2 as the surface needs: programs, meshes, textures, and where the camera stands.

/** Compiled beside what else the page does, where the browser can: ask `ready` before `use`. */
export class Program {
  /** units: of its textures, by name. */
  constructor(gl, vertex, fragment, units = {}) {
    Object.assign(this, { gl, units, program: gl.createProgram(), uniforms: null });
    this.shaders = [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].map(([kind, text]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
      return shader;
    });
    gl.linkProgram(this.program);
    this.aside = gl.getExtension("KHR_parallel_shader_compile");
  }

  /** Throws Error with what the compiler says where it refuses. */
  get ready() {
    const { gl, program } = this;
    if (this.uniforms) return true;
    if (this.aside && !gl.getProgramParameter(program, this.aside.COMPLETION_STATUS_KHR)) return false;
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      throw new Error([gl.getProgramInfoLog(program), ...this.shaders.map((each) => gl.getShaderInfoLog(each))].join("\n"));
    }
    this.uniforms = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      this.uniforms[name] = gl.getUniformLocation(program, name);
    }
    gl.useProgram(program);
    for (const [name, unit] of Object.entries(this.units)) gl.uniform1i(this.uniforms[name], unit);
    return true;
  }

  /** values: numbers, or arrays of 2, 3, 4 (vectors), 9, 16 (matrices by columns). What the program lacks is left out. */
  use(values) {
    const { gl } = this;
    gl.useProgram(this.program);
    for (const [name, value] of Object.entries(values)) {
      const at = this.uniforms[name];
      if (!at) continue;
      if (typeof value === "number") gl.uniform1f(at, value);
      else if (value.length === 16) gl.uniformMatrix4fv(at, false, value);
      else if (value.length === 9) gl.uniformMatrix3fv(at, false, value);
      else gl[`uniform${value.length}fv`](at, value);
    }
  }
}

/** A function that draws the mesh; attribute 0 is the place, 1 the normal. */
export function drawing(gl, { vertices, triangles }) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(triangles), gl.STATIC_DRAW);
  for (const at of [0, 1]) {
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 24, 12 * at);
  }
  return () => {
    gl.bindVertexArray(array);
    gl.drawElements(gl.TRIANGLES, triangles.length, gl.UNSIGNED_INT, 0);
  };
}

/** A function that puts numbers, four a pixel, into the texture of this unit: Float32Array, or bytes as colours. */
export function picture(gl, unit) {
  const texture = gl.createTexture();
  return (values, width, height) => {
    const bytes = values instanceof Uint8Array;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, bytes ? gl.RGBA8 : gl.RGBA16F, width, height, 0, gl.RGBA, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, values);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  };
}

const NEAR = 0.1, FAR = 30;

/**
 * Of a camera that looks at `middle` from `away`, turned about z and tilted up from the plane [rad]: its place `eye`,
 * the axis to its `right`, and the `matrix` to the clip space. lens: tangent of half of what it sees upwards.
 */
export function camera({ turn, tilt, away, aspect, lens, middle }) {
  const [s, c, st, ct] = [Math.sin(turn), Math.cos(turn), Math.sin(tilt), Math.cos(tilt)];
  const right = [c, s, 0], up = [-st * s, st * c, ct], back = [ct * s, -ct * c, st];
  const along = (axis) => axis.reduce((sum, v, k) => sum + v * middle[k], 0);
  const rows = [[...right, -along(right)].map((v) => v / (lens * aspect)), [...up, -along(up)].map((v) => v / lens)];
  const depth = [...back, -along(back) - away], scale = (NEAR + FAR) / (NEAR - FAR);
  rows.push(depth.map((v, k) => scale * v + (k === 3 ? (2 * NEAR * FAR) / (NEAR - FAR) : 0)), depth.map((v) => -v));
  const matrix = Float32Array.from({ length: 16 }, (_, k) => rows[k % 4][k >> 2]);
  return { matrix, right, eye: back.map((v, k) => middle[k] + away * v) };
}
