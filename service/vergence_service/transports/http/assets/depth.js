// Draws a depth map: the image, disparity and sigma as pictures, and a point cloud that turns.

const STOPS = [
  [68, 1, 84], [72, 40, 120], [62, 73, 137], [49, 104, 142], [38, 130, 142],
  [31, 158, 137], [53, 183, 121], [110, 206, 88], [181, 222, 43], [253, 231, 37],
]; // of viridis: far is dark, near is bright
const NOTHING = [223, 227, 232]; // where there is no value
const FULL_SIGMA_PX = 4; // of the brightest colour
const SWAY_RAD = 0.35;
const SWAY_S = 6;
const MOST_POINTS = 90000;

const COLOURS = Array.from({ length: 256 }, (_, index) => {
  const place = (index / 255) * (STOPS.length - 1);
  const [low, high] = [STOPS[Math.floor(place)], STOPS[Math.ceil(place)]];
  return low.map((value, channel) => value + (high[channel] - value) * (place % 1));
});

export class DepthViewer {
  // `canvases` are {image, disparity, sigma, cloud}; `readout` gets the words about a point.
  constructor(canvases, readout, scale) {
    this.canvases = canvases;
    this.readout = readout;
    this.scale = scale;
    this.maxSigma = FULL_SIGMA_PX;
    this.map = null;
    this.range = null;
    this.turned = { yaw: 0, pitch: 0, byHand: false };
    this.pointer = null;
    for (const name of ["image", "disparity", "sigma"]) this.#readUnder(canvases[name]);
    this.#turnByHand(canvases.cloud);
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const draw = (now_ms) => {
      if (!this.turned.byHand && !still) {
        this.turned.yaw = SWAY_RAD * Math.sin((now_ms / 1000 / SWAY_S) * 2 * Math.PI);
      }
      if (this.map) this.#drawCloud();
      requestAnimationFrame(draw);
    };
    requestAnimationFrame(draw);
  }

  // A map is {width, height, image, disparity, sigma, fx, fy, cx, cy, baseline_m, every}, with
  // planes as Float32Array in pixels (NaN: no value), and null for what is not known.
  show(map) {
    this.map = map;
    const { width, height } = map;
    for (const name of ["image", "disparity", "sigma"]) {
      Object.assign(this.canvases[name], { width, height });
    }
    const context = this.canvases.image.getContext("2d", { willReadFrequently: true });
    context.drawImage(map.image, 0, 0, width, height);
    map.colours = context.getImageData(0, 0, width, height).data;
    this.redraw();
  }

  redraw() {
    if (!this.map) return;
    const { disparity, sigma } = this.map;
    const shown = disparity.map((value, at) => (sigma[at] > this.maxSigma ? NaN : value));
    this.map.shown = shown;
    const [low, high] = this.#steadyRange(shown);
    paint(this.canvases.disparity, shown, (value) => (value - low) / (high - low));
    paint(this.canvases.sigma, sigma, (value) => value / FULL_SIGMA_PX);
    this.scale.textContent = `${this.#words(high)} (bright) to ${this.#words(low)} (dark)`;
    this.#read();
  }

  // From frame to frame the colours change slowly, so that one colour is one depth.
  #steadyRange(values) {
    const sorted = values.filter((value) => !Number.isNaN(value)).sort();
    if (!sorted.length) return this.range ?? [0, 1];
    const at = (share) => sorted[Math.floor(share * (sorted.length - 1))];
    const now = [at(0.01), Math.max(at(0.99), at(0.01) + 1)];
    this.range = (this.range ?? now).map((before, index) => before + (now[index] - before) / 4);
    return this.range;
  }

  #words(disparity_px) {
    const { fx, baseline_m } = this.map;
    if (!baseline_m) return `${disparity_px.toFixed(1)} px`;
    return `${((fx * baseline_m) / Math.max(disparity_px, 0.01)).toFixed(2)} m`;
  }

  #readUnder(canvas) {
    canvas.addEventListener("pointermove", (event) => {
      const box = canvas.getBoundingClientRect();
      const column = (event.clientX - box.left) / box.width;
      const row = (event.clientY - box.top) / box.height;
      this.pointer = [column, row];
      this.#read();
    });
    canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
      this.#read();
    });
  }

  #read() {
    if (!this.pointer || !this.map) {
      this.readout.textContent = "Point at a picture to read the depth there.";
      return;
    }
    const { width, height, every, disparity, sigma, fx, baseline_m } = this.map;
    const column = Math.min(Math.floor(this.pointer[0] * width), width - 1);
    const row = Math.min(Math.floor(this.pointer[1] * height), height - 1);
    const [value, error] = [disparity[row * width + column], sigma[row * width + column]];
    let words = "no value";
    if (!Number.isNaN(value)) {
      words = `disparity ${value.toFixed(2)} px, expected error ${error.toFixed(2)} px`;
      if (baseline_m) {
        const depth_m = (fx * baseline_m) / value;
        words = `${depth_m.toFixed(3)} m, expected error ${((depth_m * error) / value).toFixed(3)} m; ${words}`;
      }
    }
    this.readout.textContent = `column ${column * every}, row ${row * every}: ${words}`;
  }

  #turnByHand(canvas) {
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.turned.byHand = true;
      this.turned.yaw += event.movementX / 200;
      this.turned.pitch += event.movementY / 200;
    });
    canvas.addEventListener("dblclick", () => {
      this.turned = { yaw: 0, pitch: 0, byHand: false };
    });
  }

  #drawCloud() {
    const { width, height, every, shown, colours } = this.map;
    // Without a calibration, any focal length and baseline give the shape up to a stretch.
    const fx = this.map.fx ?? width * every;
    const fy = this.map.fy ?? fx;
    const base = this.map.baseline_m || 0.1;
    const [cx, cy] = [this.map.cx ?? (width * every) / 2, this.map.cy ?? (height * every) / 2];
    const far = (fx * base) / Math.max(this.range[0], 0.01);
    const near = (fx * base) / this.range[1];
    const centre = 2 / (1 / near + 1 / far);
    const canvas = this.canvases.cloud;
    if (canvas.width !== width) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    const picture = context.createImageData(width, height);
    const pixels = new Uint32Array(picture.data.buffer).fill(0xff30251c);
    const nearest = new Float32Array(width * height).fill(Infinity);
    const [sy, cyaw] = [Math.sin(this.turned.yaw), Math.cos(this.turned.yaw)];
    const [sp, cp] = [Math.sin(this.turned.pitch), Math.cos(this.turned.pitch)];
    const step = Math.ceil(Math.sqrt((width * height) / MOST_POINTS));
    const size = step + 1; // of a point in pixels: no gaps where nothing is turned
    for (let row = 0; row < height; row += step) {
      for (let column = 0; column < width; column += step) {
        const at = row * width + column;
        const disparity = shown[at];
        if (!(disparity > 0)) continue;
        const z = (fx * base) / disparity;
        if (z > 2 * far) continue;
        const x = ((column * every - cx) * z) / fx;
        const y = ((row * every - cy) * z) / fy;
        const [turnedX, zYaw] = [cyaw * x + sy * (z - centre), cyaw * (z - centre) - sy * x];
        const [turnedY, zBoth] = [cp * y - sp * zYaw, sp * y + cp * zYaw + centre];
        if (zBoth < near / 4) continue;
        const left = Math.round((turnedX * fx) / zBoth / every + cx / every);
        const top = Math.round((turnedY * fy) / zBoth / every + cy / every);
        const colour =
          0xff000000 | (colours[4 * at + 2] << 16) | (colours[4 * at + 1] << 8) | colours[4 * at];
        for (let v = Math.max(top, 0); v < Math.min(top + size, height); v++) {
          for (let u = Math.max(left, 0); u < Math.min(left + size, width); u++) {
            if (zBoth < nearest[v * width + u]) {
              nearest[v * width + u] = zBoth;
              pixels[v * width + u] = colour;
            }
          }
        }
      }
    }
    context.putImageData(picture, 0, 0);
  }
}

function paint(canvas, values, share) {
  const context = canvas.getContext("2d");
  const picture = context.createImageData(canvas.width, canvas.height);
  values.forEach((value, at) => {
    const colour = Number.isNaN(value)
      ? NOTHING
      : COLOURS[Math.round(255 * Math.min(Math.max(share(value), 0), 1))];
    picture.data.set(colour, 4 * at);
    picture.data[4 * at + 3] = 255;
  });
  context.putImageData(picture, 0, 0);
}
