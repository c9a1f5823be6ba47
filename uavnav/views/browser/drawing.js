/*
 * Drawing the tasks of world.js: the arena with its drones, and one value for each action. Words for numbers,
 * too, and what plays.
 *
 * The page gives the colours, as the CSS properties --fg, --bg, --muted, --accent and --obstacle.
 */

const COLOURS = ["fg", "bg", "muted", "accent", "obstacle"];
const CIVIDIS = [
  [0, 34, 77], [26, 56, 111], [67, 78, 107], [97, 100, 111], [124, 123, 120],
  [155, 147, 118], [187, 173, 108], [222, 201, 87], [253, 231, 55],
]; // dark to bright evenly, to any colour vision

/** A number to so many decimals, with a minus as in print. */
function fixed(number, decimals) {
  return number.toFixed(decimals).replace(/^-(0(\.0*)?)$/, "$1").replace("-", "\u2212");
}

/** A number to three digits; what is next to nothing is told as such. */
function short(number) {
  if (number !== 0 && Math.abs(number) < 0.0005) return number > 0 ? "< 0.001" : "> \u22120.001";
  return String(Number(number.toPrecision(3))).replace("-", "\u2212");
}

/** An action: [degrees, px], or of a box [yaw, pitch, px]. */
function inWords(action) {
  const [degrees, pitch = 0] = action.slice(0, -1);
  const pixels = action.at(-1);
  const turn = degrees === 0 ? "no turn" : `turn ${Math.abs(degrees)}° ${degrees > 0 ? "left" : "right"}`;
  const tilt = pitch === 0 ? "" : `, nose ${Math.abs(pitch)}° ${pitch > 0 ? "up" : "down"}`;
  return `${turn}${tilt}, ${pixels === 0 ? "stay" : `fly ${pixels} px`}`;
}

/** Base64 as bytes. */
function bytesOf(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

/** A text of an element, written only where it is another. */
function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

const STEPS_PER_SECOND = 30; // at speed 1
const LONGEST_PAUSE = 0.1; // [s] between two pictures; after a longer one (a hidden page) play does not jump

/** The name of a key, whether Shift is down or not. */
function nameOfKey({ key }) { return key === " " ? "space" : key.toLowerCase(); }

/** The same if nothing else uses it: a button has Space and Enter, a slider arrows, a field or a list all. */
function freeKey(event) {
  const [key, { target }] = [nameOfKey(event), event];
  const pressed = target.closest("button, summary") && ["space", "enter"].includes(key);
  const slid = target.closest("input[type=range]") && key.startsWith("arrow");
  const taken = pressed || slid || target.closest("select, input:not([type=range])");
  return taken || event.altKey || event.ctrlKey || event.metaKey ? undefined : key;
}

/**
 * What plays: a class of it says how to begin (`start`), end (`pause`), and what a picture needs (`frame`).
 * In its place on the page an element with `data-act` calls a method, with the number of its `data-by`: a
 * button by a click, and any by its `data-keys`, where it `data-repeats` also while one is held down. One
 * button's act is `toggle`.
 */
class Playing {
  #playing = false;

  listenTo(place) {
    this.button = place.querySelector("button[data-act=toggle]");
    for (const button of place.querySelectorAll("button[data-act]")) {
      button.addEventListener("click", () => this.act(button));
    }
    place.addEventListener("keydown", (event) => {
      const key = freeKey(event);
      const named = key && place.querySelector(`[data-keys~="${CSS.escape(key)}"]`);
      if (!named) return;
      event.preventDefault();
      if (!event.repeat || "repeats" in named.dataset) this.act(named);
    });
  }

  act({ dataset: { act, by } }) { this[act](Number(by)); }

  get playing() { return this.#playing; }

  set playing(playing) {
    this.#playing = playing;
    this.button.textContent = playing ? "Pause" : "Play";
  }

  toggle() {
    if (this.playing) this.pause();
    else this.start();
  }

  /** Call `frame` at each picture with the seconds since the last, while this plays; one loop at a time. */
  play() {
    let before = performance.now();
    const turn = (this.turn = {});
    const tick = (now) => {
      if (!this.playing || this.turn !== turn) return;
      const passed = clamp((now - before) / 1000, 0, LONGEST_PAUSE); // a tick may lie before the click
      before = now;
      this.frame(passed);
      requestAnimationFrame(tick);
    };
    this.playing = true;
    requestAnimationFrame(tick);
  }
}

/** Have `draw` called when a canvas in an element has another size, now too, and when the colours change. */
function watchLooks(element, draw) {
  const sizes = new ResizeObserver(draw);
  for (const canvas of element.querySelectorAll("canvas")) sizes.observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
}

/** The page's colours where an element stands, as they are now, by their names. */
function readColours(element) {
  const style = getComputedStyle(element);
  return Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`)]));
}

/** Black or white, whichever is read more easily on a colour "#rrggbb". */
function inkOn(colour) {
  const [red, green, blue] = [1, 3, 5].map((at) => (parseInt(colour.slice(at, at + 2), 16) / 255) ** 2.2);
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.18 ? "#000000" : "#ffffff";
}

/** Fit a canvas to its place on the screen: its context, cleared, in CSS px, its size and its colours. */
function fit(canvas) {
  const { width, height } = canvas.getBoundingClientRect();
  const size = [width, height].map((side) => Math.max(1, Math.round(side * devicePixelRatio)));
  [canvas.width, canvas.height] = size; // which clears it
  const context = canvas.getContext("2d");
  context.scale(devicePixelRatio, devicePixelRatio);
  return { context, width, height, colours: readColours(canvas) };
}

function disc(context, x, y, radius, colour) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = colour;
  context.fill();
}

function ring(context, x, y, radius, width, colour) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke();
}

function line(context, points, width, colour) {
  context.beginPath();
  points.forEach(([x, y], place) => (place ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.lineWidth = width;
  context.strokeStyle = colour;
  context.stroke();
}

function drawBorder(context, world, colours) {
  const { width, height, border } = world;
  const gap = 1; // [px] between two squares, so that they are seen as such
  context.fillStyle = colours.muted;
  for (let x = 0; x < width; x += border) {
    for (let y = 0; y < height; y += border) {
      const inside = x > 0 && x < width - border && y > 0 && y < height - border;
      if (!inside) context.fillRect(x + gap / 2, y + gap / 2, border - gap, border - gap);
    }
  }
}

function drawSensor(context, world, { x, y, angle }, colours) {
  const half = (world.sensor_arc / 360) * Math.PI;
  context.beginPath();
  context.moveTo(x, y);
  context.arc(x, y, world.sensor_radius, angle - half, angle + half);
  context.closePath();
  context.fillStyle = context.strokeStyle = colours.accent;
  context.globalAlpha = 0.15;
  context.fill();
  context.globalAlpha = 0.6;
  context.lineWidth = 1;
  context.stroke();
  context.globalAlpha = 1;
}

/** The point [x, y] at a distance from another one, in a direction [radians]. */
function pointAt([x, y], angle, distance) {
  return [x + distance * Math.cos(angle), y + distance * Math.sin(angle)];
}

/**
 * A drone: a disc in its colour with a line towards its heading, the shorter the less of it is in the plane;
 * after a collision a faint disc and a cross.
 */
function drawDrone(context, world, { x, y, angle, reach = 1 }, crashed, thick, colours) {
  const to = (degrees, share) => pointAt([x, y], angle + radians(degrees), share * world.drone_radius);
  context.globalAlpha = crashed ? 0.35 : 1;
  disc(context, x, y, world.drone_radius, colours.accent);
  context.globalAlpha = 1;
  if (crashed) {
    for (const turn of [45, 135]) line(context, [to(turn, 1), to(turn, -1)], 4 * thick, colours.accent);
  } else line(context, [[x, y], to(0, reach)], 4, colours.ink);
}

const SHADES = 8; // of a trail that fades

/** A trail that is the fainter, the longer ago. */
function drawFading(context, trail, width, colour) {
  context.lineCap = "butt"; // round ends would lie over one another
  for (let shade = 0; shade < SHADES; shade += 1) {
    const [first, last] = [shade, shade + 1].map((one) => Math.floor((one * (trail.length - 1)) / SHADES));
    context.globalAlpha = (shade + 1) / SHADES;
    line(context, trail.slice(first, last + 1), width, colour);
  }
  context.globalAlpha = 1;
  context.lineCap = "round";
}

/** A rim around a drone, and its sign behind its line, upright whatever the drone's heading. */
function drawSign(context, world, { x, y, angle }, sign, colours) {
  ring(context, x, y, world.drone_radius, 2, colours.fg);
  context.save();
  context.translate(...pointAt([x, y], angle, -0.42 * world.drone_radius));
  context.scale(1, -1);
  context.fillStyle = colours.ink;
  context.font = `700 ${0.8 * world.drone_radius}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(sign, 0, 0);
  context.restore();
}

const AHEAD = 12; // [steps] that the line of a moving circle shows

/** Where a circle that moves will be soon: a line from its centre. */
function drawDrift(context, [x, y, , vx, vy], thick, colours) {
  line(context, [[x, y], [x + AHEAD * vx, y + AHEAD * vy]], 2 * thick, colours.muted);
  disc(context, x, y, 3 * thick, colours.muted);
}

/** A goal: the ring within which it is reached, and a mark in its middle. */
function drawGoal(context, world, [x, y], thick, colours) {
  const radius = world.goal_radius;
  for (const reach of [radius, radius / 2]) ring(context, x, y, reach, 3 * thick, colours.fg);
  disc(context, x, y, radius / 6, colours.fg);
}

/** A drone with its sensor, its trail and what it senses: see drawArena. */
function drawEpisode(context, world, drone, thick, given) {
  const { pose, trail, sensed, crashed, sign, faint, fades, accent = given.accent, ink = given.bg } = drone;
  const colours = { ...given, accent, ink };
  if (!faint && !crashed) drawSensor(context, world, pose, colours);
  (fades ? drawFading : line)(context, trail, (faint ? 2 : 2.5) * thick, colours.accent);
  for (const point of sensed) line(context, [[pose.x, pose.y], point], 1.5 * thick, colours.fg);
  drawDrone(context, world, pose, crashed, thick, colours);
  if (sign && !crashed) drawSign(context, world, pose, sign, colours);
  for (const point of sensed) disc(context, ...point, 5 * thick, colours.fg);
}

/**
 * The arena from above, its circles and its drones in their order.
 *
 * A circle is [x, y, radius], with [vx, vy] if it moves; a pale one [x, y, radius, opacity]; a goal [x, y].
 * Each drone has a pose { x, y, angle [radians] }, the trail [x, y] that it flew, and the points that it
 * senses; perhaps `crashed`, `sign` (a character), `accent` (its colour) and `ink` (on it), `faint` where its
 * sensor is not to be shown, and `fades` where its trail does.
 */
function drawArena(canvas, { world, circles, pale = [], goal, drones }) {
  const { context, width, colours } = fit(canvas);
  const scale = width / world.width;
  context.fillStyle = colours.bg;
  context.fillRect(0, 0, width, scale * world.height);
  context.transform(scale, 0, 0, -scale, 0, scale * world.height); // the one place where y is flipped
  context.lineCap = context.lineJoin = "round";
  for (const [x, y, radius, opacity] of pale) {
    context.globalAlpha = opacity;
    disc(context, x, y, radius, colours.obstacle);
  }
  context.globalAlpha = 1;
  for (const [x, y, radius] of circles) disc(context, x, y, radius, colours.obstacle);
  drawBorder(context, world, colours);
  const thick = Math.max(1, 0.6 / scale); // lines must be seen on a small screen too
  for (const circle of circles) if (circle[3] || circle[4]) drawDrift(context, circle, thick, colours);
  if (goal) drawGoal(context, world, goal, thick, colours);
  for (const drone of drones) drawEpisode(context, world, drone, thick, colours);
  return { context, thick, colours };
}

function colourOf(share) {
  const place = clamp(share, 0, 1) * (CIVIDIS.length - 1);
  const low = Math.min(Math.floor(place), CIVIDIS.length - 2);
  const between = (part, index) => Math.round(part + (place - low) * (CIVIDIS[low + 1][index] - part));
  const mix = CIVIDIS[low].map(between);
  return `rgb(${mix.join(" ")})`;
}

/**
 * Colour the squares of a picture of values (values.html), each by its `shares` of the way from the value
 * `low` to `high`, and frame the chosen one. Without shares it has the words that `instead` gives.
 */
function showValues(picture, { instead = "", shares, chosen, low, high }) {
  [...picture.querySelector(".values-actions").children].forEach((square, action) => {
    square.style.background = shares ? colourOf(shares(action)) : "";
    square.classList.toggle("chosen", action === chosen);
  });
  const colours = CIVIDIS.map((colour) => `rgb(${colour.join(" ")})`);
  picture.querySelector(".values-colours").style.background = `linear-gradient(to right, ${colours})`;
  picture.querySelector(".values-legend").style.visibility = shares ? "visible" : "hidden";
  say(picture.querySelector(".values-low"), shares ? short(low) : "");
  say(picture.querySelector(".values-high"), shares ? short(high) : "");
  say(picture.querySelector(".values-instead"), instead);
}
