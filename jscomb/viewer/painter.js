/* Paints linear images and their errors into 2D canvases, by one WebGL context a page. */
const VERTEX = `#version 300 es
in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }`;

/* A pixel of the canvas is the mean of up to 16 points of the image: of what is displayed,
   before its gamma, or of the error, before its colour. */
const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
uniform highp sampler2D image, reference, map, colours;
uniform vec2 origin;        // the canvas's top left corner, in pixels of the image
uniform float scale;        // pixels of the image to one of the canvas
uniform float height;       // of the canvas
uniform ivec2 size;         // of the image
uniform int channels, kind, curve;  // kind: 0 image, 1 relative squared, 2 signed, 3 map
uniform float gain, low, high, epsilon;
uniform bool logarithmic;
out vec4 colour;

bool bad(float v) { return isnan(v) || isinf(v); }
vec3 texel(highp sampler2D of, ivec2 at) {
  vec3 v = texelFetch(of, at, 0).rgb;
  return channels == 1 ? v.rrr : v;
}
vec3 toned(vec3 v) {
  v = max(v * gain, 0.0);
  if (curve == 1) {  // filmic
    v = min(v, 1e6);
    v = v * (2.51 * v + 0.03) / (v * (2.43 * v + 0.59) + 0.14);
  } else if (curve == 2) {  // Reinhard
    v = v / (1.0 + v);
  }
  return clamp(v, 0.0, 1.0);
}
vec3 displayed(vec3 v) {
  if (curve == 3) return v;  // linear
  return mix(12.92 * v, 1.055 * pow(v, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v));
}
float error(ivec2 at) {
  if (kind == 3) return texelFetch(map, at, 0).r;
  vec3 r = texel(reference, at), d = texel(image, at) - r;
  float grey = (r.r + r.g + r.b) / 3.0, weight = grey * grey + epsilon;
  if (kind == 1) return dot(d, d) / 3.0 / weight;
  return (d.r + d.g + d.b) / 3.0 / sqrt(weight);
}
vec3 coloured(float e) {
  if (kind == 2) {
    float share = clamp(abs(e) / high, 0.0, 1.0);
    vec3 full = e > 0.0 ? vec3(0.85, 0.1, 0.1) : vec3(0.1, 0.3, 0.9);
    return mix(vec3(1.0), full, sqrt(share));
  }
  float share = logarithmic
    ? log(max(e, 1e-30) / low) / log(high / low) : (e - low) / (high - low);
  return texelFetch(colours, ivec2(int(clamp(share, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
}
void main() {
  vec2 corner = origin + vec2(gl_FragCoord.x - 0.5, height - gl_FragCoord.y - 0.5) * scale;
  int count = clamp(int(ceil(scale - 0.01)), 1, 4);
  vec3 sum = vec3(0.0);
  float total = 0.0, points = 0.0;
  bool spoilt = false;
  for (int i = 0; i < count * count; i++) {
    vec2 within = (vec2(i % count, i / count) + 0.5) / float(count);
    ivec2 at = ivec2(floor(corner + within * scale));
    if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) continue;
    if (kind == 0) {
      vec3 v = texel(image, at);
      if (bad(v.r) || bad(v.g) || bad(v.b)) spoilt = true; else sum += toned(v);
    } else {
      float e = error(at);
      if (bad(e)) spoilt = true; else total += e;
    }
    points += 1.0;
  }
  if (points == 0.0) colour = vec4(0.0);
  else if (spoilt) colour = vec4(1.0, 0.0, 1.0, 1.0);
  else colour = vec4(kind == 0 ? displayed(sum / points) : coloured(total / points), 1.0);
}`;

const KINDS = { image: 0, relative: 1, signed: 2 };
const CURVES = { sRGB: 0, filmic: 1, Reinhard: 2, linear: 3 };
const MOST_BYTES = 2 ** 30;  // of textures that are kept

/* colours: 256 RGB bytes of a colour map. Null where there is no WebGL 2. */
function makePainter(colours) {
  const canvas = document.createElement("canvas");
  const gl = canvas.getContext("webgl2", { antialias: false, premultipliedAlpha: true });
  if (!gl) return null;
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "corner");
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = name => gl.getUniformLocation(program, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
  ["image", "reference", "map", "colours"].forEach((name, unit) => gl.uniform1i(at(name), unit));

  const textures = new Map();  // the least recently used first
  let bytes = 0;
  function texture(pixels) {
    const { width, height, channels, values } = pixels;
    let made = textures.get(pixels);
    textures.delete(pixels);
    if (!made) {
      made = gl.createTexture();
      bytes += values.byteLength;
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
      const half = values instanceof Uint16Array, one = channels === 1;
      const inside = half ? (one ? gl.R16F : gl.RGB16F) : one ? gl.R32F : gl.RGB32F;
      gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, one ? gl.RED : gl.RGB,
        half ? gl.HALF_FLOAT : gl.FLOAT, values);
      nearest();
    }
    textures.set(pixels, made);
    return made;
  }
  function nearest() {
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }
  function forget(used) {
    for (const [pixels, made] of textures) {
      if (bytes <= MOST_BYTES) return;
      if (used.includes(pixels)) continue;
      gl.deleteTexture(made);
      textures.delete(pixels);
      bytes -= pixels.values.byteLength;
    }
  }
  gl.activeTexture(gl.TEXTURE3);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, colours);
  nearest();
  gl.activeTexture(gl.TEXTURE0);

  /* Into a 2D canvas. how: image, reference, map (pixels or null), kind, origin, scale, gain,
     curve, range [low, high], logarithmic, epsilon. */
  function paint(target, how) {
    if (canvas.width < target.width || canvas.height < target.height) {
      canvas.width = Math.max(canvas.width, target.width);
      canvas.height = Math.max(canvas.height, target.height);
    }
    const given = [how.image, how.reference || how.image, how.map || how.image];
    given.forEach((pixels, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture(pixels));
    });
    gl.activeTexture(gl.TEXTURE0);
    forget(given);
    gl.viewport(0, 0, target.width, target.height);
    gl.uniform2f(at("origin"), ...how.origin);
    gl.uniform1f(at("scale"), how.scale);
    gl.uniform1f(at("height"), target.height);
    gl.uniform2i(at("size"), how.image.width, how.image.height);
    gl.uniform1i(at("channels"), how.image.channels);
    gl.uniform1i(at("kind"), KINDS[how.kind] ?? 3);
    gl.uniform1i(at("curve"), CURVES[how.curve]);
    gl.uniform1f(at("gain"), how.gain);
    gl.uniform1f(at("low"), how.range[0]);
    gl.uniform1f(at("high"), how.range[1]);
    gl.uniform1i(at("logarithmic"), how.logarithmic);
    gl.uniform1f(at("epsilon"), how.epsilon);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const context = target.getContext("2d");
    context.clearRect(0, 0, target.width, target.height);
    // The viewport is at the lower left of the shared canvas.
    context.drawImage(canvas, 0, canvas.height - target.height, target.width, target.height,
      0, 0, target.width, target.height);
  }
  return Object.assign(paint, { largest: gl.getParameter(gl.MAX_TEXTURE_SIZE) });
}

/* Bytes of a deflated, base64 text whose numbers were split into planes of bytes. */
async function unpacked(text, type, count) {
  const packed = Uint8Array.fromBase64
    ? Uint8Array.fromBase64(text) : Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const bits = type === "half" ? new Uint16Array(count) : new Uint32Array(count);
  for (let plane = 0; plane * count < planes.length; plane++) {
    const start = plane * count, shift = 8 * plane;
    for (let i = 0; i < count; i++) bits[i] |= planes[start + i] << shift;
  }
  return type === "half" ? bits : new Float32Array(bits.buffer);
}

/* The number that 16 bits stand for. */
function half(bits) {
  const e = bits >> 10 & 31, m = bits & 1023, s = bits >> 15 ? -1 : 1;
  return s * (e === 0 ? m * 2 ** -24 : e === 31 ? (m ? NaN : Infinity) : (1 + m / 1024) * 2 ** (e - 15));
}
