/*
 * A scene as the fragment of a link, and back. A fragment is data of strangers: each part is checked, and
 * what does not pass is named and left out.
 *
 * A scene is { task, layouts, layout, k, circles, pilots, focus, speed, greedy, seed } and settings of
 * the task. `layouts` names a split of the page, whose layout number `layout` is Python's, or is RANDOM: then
 * the number is a seed, and k says how many circles there are. `circles` [x, y, radius] px are drawn by
 * hand, or null. `pilots` fly in the next race; `seed` is of all random numbers.
 */

const YOU = "you";
const NOBODY = "nobody";
const RANDOM = "random";
const MOST_DRONES = 4;
const MOST_CIRCLES = 48;
const LAST_NUMBER = 2 ** 32 - 1; // of random layouts and of seeds

/** A number from low to high in whole steps, as a slider has it. */
function readNumber(text, { low = 0, high, step = 1 }) {
  const number = /^\d{1,10}(\.\d{1,6})?$/.test(text) ? Number(text) : NaN;
  const steps = number / step;
  return number >= low && number <= high && Math.abs(steps - Math.round(steps)) < 1e-6 ? number : undefined;
}

/** A circle "x_y_radius" with at most one decimal, within the world; a race says if the start is free. */
function readCircle(world, text) {
  const match = /^(\d{1,3}(?:\.\d)?)_(\d{1,3}(?:\.\d)?)_(\d{2,3}(?:\.\d)?)$/.exec(text);
  if (!match) return undefined;
  const [x, y, radius] = match.slice(1).map((number) => f32(Number(number)));
  const fits = x <= world.width && y <= world.height;
  const sized = radius >= world.obstacle_radius_min && radius <= world.obstacle_radius_max;
  return fits && sized ? [x, y, radius] : undefined;
}

function readCircles(world, text) {
  const circles = text === "none" ? [] : text.split("~").map((part) => readCircle(world, part));
  return circles.length <= MOST_CIRCLES && circles.every(Boolean) ? circles : undefined;
}

/** A text that is a choice of a list of the page. */
function readChoice(list, text) {
  return [...document.getElementById(list).options].find(({ value }) => value === text)?.value;
}

function readPilots(text) {
  const pilots = text.split("~");
  const right = pilots.length === MOST_DRONES && pilots.every((pilot) => readChoice("pilot", pilot));
  return right && pilots.filter((pilot) => pilot === YOU).length <= 1 ? pilots : undefined;
}

/** How each part of a scene is read from a text: undefined where it is wrong. world: of the circles. */
function readers(settings, world) {
  const parts = {
    task: (text) => readChoice("task", text),
    layouts: (text) => readChoice("layouts", text),
    layout: (text) => readNumber(text, { high: LAST_NUMBER }),
    k: (text) => readNumber(text, { high: MOST_CIRCLES }),
    circles: (text) => readCircles(world, text),
    pilots: readPilots,
    focus: (text) => readNumber(text, { low: 1, high: MOST_DRONES }),
    speed: (text) => readChoice("speed", text) && Number(text),
    greedy: (text) => (["yes", "no"].includes(text) ? text === "yes" : undefined),
    seed: (text) => readNumber(text, { high: LAST_NUMBER }),
  };
  for (const [name, slider] of Object.entries(settings)) parts[name] = (text) => readNumber(text, slider);
  return parts;
}

/** The parts of a scene that a fragment #... gives, and the names of those that are wrong: [scene, wrong]. */
function readLink(fragment, read) {
  const [scene, wrong] = [{}, []];
  for (const [name, text] of new URLSearchParams(fragment.slice(1))) {
    const value = Object.hasOwn(read, name) ? read[name](text) : undefined;
    if (value === undefined) wrong.push(name.slice(0, 20));
    else scene[name] = value;
  }
  return [scene, wrong];
}

/**
 * The fragment of a scene, without the #; settings are in it that the task has, and that are not as they come
 * on every page, or come otherwise on this one.
 */
function writeLink(scene, settings) {
  const circles = scene.circles?.map((circle) => circle.map((number) => Number(number.toFixed(1))).join("_"));
  const texts = {
    ...scene,
    circles: circles?.join("~") || "none",
    pilots: scene.pilots.join("~"),
    greedy: scene.greedy ? "yes" : "no",
  };
  const isTold = ([name]) => {
    if (name === "k") return scene.layouts === RANDOM;
    if (name === "circles") return scene.circles !== null;
    if (!settings[name]) return true;
    const { first, here, tasks } = settings[name];
    return (scene[name] !== first || here !== first) && (!tasks.length || tasks.includes(scene.task));
  };
  return Object.entries(texts).filter(isTold).map((part) => part.join("=")).join("&");
}
