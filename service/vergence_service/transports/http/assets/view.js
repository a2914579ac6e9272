// The depth of a stream, live, if the address names one; otherwise of two images from the viewer.

import { DepthViewer } from "/assets/depth.js";

const MOST_A_SECOND = 8; // views, so that watching costs the server little
const STEPS_PER_PX = 64;
const MOST_COLUMNS = 480;

const find = (id) => document.getElementById(id);
const viewer = new DepthViewer(
  { image: find("image"), disparity: find("disparity"), sigma: find("sigma"), cloud: find("cloud") },
  find("readout"),
  find("scale"),
);

function say(words) {
  find("status").textContent = words;
}

async function refusal(answer) {
  if (answer.status === 401) location.assign("/login");
  const { title, detail } = await answer.json();
  return detail ?? title;
}

// The format is described in vergence_service/transports/http/viewing.py.
async function parsed(buffer) {
  const headerBytes = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, headerBytes)));
  const jpegAt = 4 + headerBytes;
  const planesAt = jpegAt + header.jpeg_bytes;
  const count = header.width * header.height;
  const plane = (index) => {
    const start = planesAt + 2 * count * index;
    const stored = new Uint16Array(buffer.slice(start, start + 2 * count));
    return Float32Array.from(stored, (value) => (value ? value / STEPS_PER_PX : NaN));
  };
  const image = await createImageBitmap(new Blob([buffer.slice(jpegAt, planesAt)]));
  return { ...header, image, disparity: plane(0), sigma: plane(1) };
}

async function follow(principal, stream) {
  const path = [principal, stream].map(encodeURIComponent).join("/");
  document.querySelector("h1").textContent = stream;
  say("waiting for a frame");
  for (;;) {
    let answer;
    try {
      answer = await fetch(`/v1/admin/streams/${path}/view`);
    } catch {
      say("the server does not answer");
      await new Promise((done) => setTimeout(done, 1000));
      continue;
    }
    if (answer.status === 204) {
      say("no frame has come for ten seconds");
    } else if (answer.ok) {
      const map = await parsed(await answer.arrayBuffer());
      viewer.show(map);
      const memory = map.step_count > 1 ? `warm for ${map.step_count - 1} frames` : map.origin;
      say(`frame ${map.frame_id}, ${memory.replaceAll("_", " ")}, range ${map.max_disparity_px.toFixed(0)} px`);
      await new Promise((done) => setTimeout(done, 1000 / MOST_A_SECOND));
    } else {
      say(await refusal(answer));
      return;
    }
  }
}

// An archive of NumPy as np.savez writes it: entries are stored, with their sizes in a zip64 field.
function arraysOf(buffer) {
  const view = new DataView(buffer);
  const arrays = {};
  for (let at = 0; view.getUint32(at, true) === 0x04034b50; ) {
    const [nameBytes, extraBytes] = [view.getUint16(at + 26, true), view.getUint16(at + 28, true)];
    const name = new TextDecoder().decode(new Uint8Array(buffer, at + 30, nameBytes));
    const short = view.getUint32(at + 18, true);
    const long = short === 0xffffffff;
    const size = long ? Number(view.getBigUint64(at + 30 + nameBytes + 12, true)) : short;
    const start = at + 30 + nameBytes + extraBytes;
    arrays[name.replace(".npy", "")] = arrayOf(buffer.slice(start, start + size));
    at = start + size;
  }
  return arrays;
}

function arrayOf(file) {
  const textBytes = new DataView(file).getUint16(8, true);
  const text = new TextDecoder().decode(new Uint8Array(file, 10, textBytes));
  const [height, width] = text.match(/'shape': \((\d+), (\d+)\)/).slice(1).map(Number);
  const Kind = text.includes("<f4") ? Float32Array : Uint8Array;
  return { height, width, values: new Kind(file.slice(10 + textBytes)) };
}

function thinned({ width, values }, every, columns, rows) {
  return Float32Array.from({ length: columns * rows }, (_, at) => {
    const [row, column] = [Math.floor(at / columns), at % columns];
    return values[row * every * width + column * every];
  });
}

async function stepPair() {
  const [left, right] = [find("left").files[0], find("right").files[0]];
  if (!left || !right) {
    say("choose two images, or drop them on this page");
    return;
  }
  const form = new FormData();
  form.append("left", left);
  form.append("right", right);
  const options = new URLSearchParams({ format: "npz" });
  for (const id of ["fx_px", "baseline_m"]) if (find(id).value) options.set(id, find(id).value);
  say("computing");
  const answer = await fetch(`/v1/pairs?${options}`, { method: "POST", body: form });
  if (!answer.ok) {
    say(await refusal(answer));
    return;
  }
  const { disparity, sigma } = arraysOf(await answer.arrayBuffer());
  const every = Math.ceil(disparity.width / MOST_COLUMNS);
  const [width, height] = [Math.ceil(disparity.width / every), Math.ceil(disparity.height / every)];
  const metric = options.has("fx_px") && options.has("baseline_m");
  viewer.range = null;
  viewer.show({
    width,
    height,
    every,
    image: await createImageBitmap(left),
    disparity: thinned(disparity, every, width, height),
    sigma: thinned(sigma, every, width, height),
    fx: metric ? Number(options.get("fx_px")) : null,
    baseline_m: metric ? Number(options.get("baseline_m")) : null,
  });
  say(`${left.name} and ${right.name}, ${disparity.width}x${disparity.height}`);
}

function dropped(event) {
  event.preventDefault();
  // Names of pairs sort: left and right, im0 and im1, image_2 and image_3.
  const files = [...event.dataTransfer.files].sort((one, other) => (one.name < other.name ? -1 : 1));
  if (files.length !== 2) {
    say(`expected two images, got ${files.length}`);
    return;
  }
  for (const [index, id] of ["left", "right"].entries()) {
    const list = new DataTransfer();
    list.items.add(files[index]);
    find(id).files = list.files;
  }
  stepPair();
}

find("most_sigma").addEventListener("input", (event) => {
  viewer.maxSigma = Number(event.target.value);
  find("most_sigma_words").textContent = `${event.target.value} px`;
  viewer.redraw();
});

const asked = new URLSearchParams(location.search);
if (asked.has("stream")) {
  follow(asked.get("principal"), asked.get("stream"));
} else {
  find("pair").hidden = false;
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", dropped);
  find("pair").addEventListener("submit", (event) => {
    event.preventDefault();
    stepPair();
  });
  say("choose two images, or drop them on this page");
}
