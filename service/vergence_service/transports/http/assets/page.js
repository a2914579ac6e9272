"use strict";

const EVERY_MS = 1000;

function row(stream) {
  const age = stream.age_p50_s === null ? "" : (1000 * stream.age_p50_s).toFixed(0);
  const cells = [
    `${stream.principal}/${stream.stream_id}`,
    `${stream.width}x${stream.height}`,
    stream.transport + (stream.address ? ` ${stream.address}` : ""),
    stream.rate_hz.toFixed(1),
    age,
    stream.model_s.toFixed(1),
    stream.last_origin ?? "",
    stream.warm_steps,
    stream.frames_stepped,
    stream.frames_dropped,
    stream.frames_failed,
    stream.idle_s.toFixed(0),
  ];
  const line = document.createElement("tr");
  line.className = stream.attached ? "" : "away";
  for (const cell of cells) {
    line.insertCell().textContent = cell; // never as HTML: clients choose the ids
  }
  return line;
}

async function refresh() {
  const summary = document.getElementById("summary");
  try {
    const answer = await fetch("/v1/admin/streams");
    if (answer.status === 401) {
      location.assign("/login");
      return;
    }
    const streams = await answer.json();
    document.getElementById("streams").replaceChildren(...streams.map(row));
    summary.textContent = streams.length === 1 ? "1 open stream" : `${streams.length} open streams`;
  } catch {
    summary.textContent = "the server does not answer";
  }
  setTimeout(refresh, EVERY_MS);
}

refresh();
