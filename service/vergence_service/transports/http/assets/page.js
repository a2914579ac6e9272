"use strict";

const EVERY_MS = 1000;
const MIB = 1 << 20;
let before = null; // the last answer, for rates

// Clients choose ids, so nothing is ever set as HTML. A cell is a text or an element.
function fill(id, rows) {
  const lines = rows.map(({ cells, away }) => {
    const line = document.createElement("tr");
    line.className = away ? "away" : "";
    for (const cell of cells) line.insertCell().append(cell);
    return line;
  });
  document.getElementById(id).replaceChildren(...lines);
}

function link(text, path, query) {
  const anchor = document.createElement("a");
  anchor.href = `${path}?${new URLSearchParams(query)}`;
  anchor.textContent = text;
  return anchor;
}

function listed(counts) {
  return Object.entries(counts)
    .filter(([, count]) => count > 0)
    .map(([why, count]) => `${count} ${why.toLowerCase().replaceAll("_", " ")}`)
    .join(", ");
}

function streamRow(stream) {
  const answered = Math.max(stream.frames_stepped, 1);
  return {
    away: !stream.attached,
    cells: [
      stream.principal,
      link(stream.stream_id, "/view", { principal: stream.principal, stream: stream.stream_id }),
      `${stream.width}x${stream.height}`,
      stream.transport + (stream.address ? ` ${stream.address}` : ""),
      stream.rate_hz.toFixed(1),
      stream.age_p50_s === null ? "" : (1000 * stream.age_p50_s).toFixed(0),
      ((1000 * stream.model_s) / answered).toFixed(1),
      stream.last_iterations || "",
      (stream.last_origin ?? "").replaceAll("_", " "),
      stream.warm_steps,
      stream.frames_stepped,
      listed({ "displaced by a newer frame": stream.frames_dropped, ...stream.failures }),
      stream.idle_s.toFixed(0),
    ],
  };
}

function sequenceRow(sequence) {
  const bar = document.createElement("progress");
  Object.assign(bar, { max: sequence.frames, value: sequence.frames_done });
  const frames = document.createElement("span");
  frames.append(bar, ` ${sequence.frames_done} of ${sequence.frames}`);
  const path = `/v1/admin/sequences/${sequence.job_id}/result`;
  const results = document.createElement("span");
  if (sequence.job_id && sequence.state === "done") {
    for (const format of ["png16", "npz", "mp4"]) results.append(link(format, path, { format }), " ");
  }
  return {
    cells: [
      sequence.principal,
      sequence.name,
      sequence.state,
      frames,
      sequence.frames_failed || "",
      sequence.eta_s === null ? "" : `${sequence.eta_s.toFixed(0)} s`,
      sequence.message ?? "",
      results,
    ],
  };
}

function principalRow(principal, elapsed_s, lanes) {
  const known = before?.server.principals.find((each) => each.principal === principal.principal);
  const used_s = principal.model_s - (known ? known.model_s : principal.model_s);
  return {
    cells: [
      principal.principal,
      principal.streams,
      elapsed_s ? `${((100 * used_s) / elapsed_s / lanes).toFixed(0)} %` : "",
      principal.model_s.toFixed(1),
      principal.megapixels_per_s.toFixed(1),
      (principal.memory_bytes / MIB).toFixed(1),
    ],
  };
}

function facts(server, streams, elapsed_s) {
  const total = (each) => each.server.principals.reduce((sum, one) => sum + one.model_s, 0);
  const busy = elapsed_s ? (total({ server }) - total(before)) / elapsed_s / server.lanes : 0;
  const memory = Object.values(server.memory_bytes).reduce((sum, each) => sum + each, 0);
  return {
    model: `${server.model} ${server.weights}, ${server.engine} on ${server.provider}`,
    version: server.version,
    "open streams": streams.length,
    "answers per second": streams.reduce((sum, each) => sum + each.rate_hz, 0).toFixed(1),
    "model busy": elapsed_s ? `${(100 * busy).toFixed(0)} % of ${server.lanes} lanes` : "",
    "streams that wait for the model": server.turns_waiting,
    memory: `${(memory / MIB).toFixed(0)} of ${(server.memory_limit_bytes / MIB).toFixed(0)} MiB`,
    sequences: listed(server.sequences) || "none",
    "open calls": server.calls_open,
  };
}

function show(answer) {
  const { server, streams } = answer;
  const elapsed_s = before ? server.at_s - before.server.at_s : 0;
  const health = document.getElementById("health");
  health.textContent = server.health;
  health.className = server.health;
  const terms = Object.entries(facts(server, streams, elapsed_s)).map(([name, value]) => {
    const item = document.createElement("div");
    item.appendChild(document.createElement("dt")).textContent = name;
    item.appendChild(document.createElement("dd")).textContent = value;
    return item;
  });
  document.getElementById("facts").replaceChildren(...terms);
  fill("streams", streams.map(streamRow));
  fill("sequences", answer.sequences.map(sequenceRow));
  fill(
    "principals",
    server.principals.map((each) => principalRow(each, elapsed_s, server.lanes)),
  );
  const refusals = Object.entries(server.refusals).flatMap(([what, counts]) =>
    Object.entries(counts).map(([why, count]) => ({ cells: [what, why, count] })),
  );
  fill("refusals", refusals);
  document.getElementById("logout").hidden = !answer.logged_in;
  before = answer;
}

async function refresh() {
  try {
    const answer = await fetch("/v1/admin/state");
    if (answer.status === 401) {
      location.assign("/login");
      return;
    }
    show(await answer.json());
  } catch {
    const health = document.getElementById("health");
    health.textContent = "the server does not answer";
    health.className = "lost";
  }
  setTimeout(refresh, EVERY_MS);
}

refresh();
