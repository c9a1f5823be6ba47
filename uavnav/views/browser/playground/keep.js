/*
 * What leaves the page, as a download: episodes that a person flew, and layouts.
 */

const KEPT = "uavnav-episodes"; // in the browser's storage

/** Let the reader save a file of these parts. */
function download(name, parts) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/**
 * The row of a drone's episode, if it is one to keep: flown by a person from start to end, on a test layout
 * of the paper's task as it is, with the time limit of an evaluation.
 */
function rowOf({ scene, task }, { pilot, state, ended, handed }, limit) {
  const usual = scene.task === "drone" && task.max_steps === limit && !task.remembers;
  const asItIs = usual && scene.layouts === "test" && !scene.circles;
  if (pilot !== YOU || !ended || handed || !asItIs) return undefined;
  const place = { seed: 0, frame: state.steps, env: scene.layout, layout: scene.layout };
  return { ...state, ...place, terminated: ended === "collision", truncated: ended !== "collision" };
}

/** Add rows to those that this browser keeps, and save all of them as a table. -> how many there are */
function keepRows(columns, rows) {
  let before = [];
  try {
    before = JSON.parse(localStorage.getItem(KEPT)) ?? [];
    localStorage.setItem(KEPT, JSON.stringify([...before, ...rows]));
  } catch {} // a browser that stores nothing: the download contains what is new
  const lines = [...before, ...rows].map((row) => columns.map((column) => row[column]).join(","));
  download("human.csv", [`${[columns.join(","), ...lines].join("\n")}\n`]);
  return lines.length;
}

/** Save rows [x, y, radius, ...] as a layout file of safetensors; facts: of its header in Python. */
async function saveRows(rows, facts) {
  const numbers = Float32Array.from(rows.flat());
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", numbers.buffer));
  const sha256 = Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
  const about = { ...facts, generator_seed: "0", n: "1", k: String(rows.length), split: "own", sha256 };
  const shape = [1, rows.length, rows[0].length];
  const tensor = { dtype: "F32", shape, data_offsets: [0, numbers.byteLength] };
  const text = JSON.stringify({ __metadata__: about, obstacles: tensor });
  const header = new TextEncoder().encode(text.padEnd(8 * Math.ceil(text.length / 8)));
  download("own.safetensors", [new BigUint64Array([BigInt(header.length)]), header, numbers]);
}
