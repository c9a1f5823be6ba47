/*
 * Which world the page begins in, and the controls that belong to a world: its sliders, its faults, and who can fly there.
 */

/** The scene of a page that is opened without a link: a person, a policy of two algorithms, and the rule. */
function firstScene(data) {
  const tasks = data.policies.map(({ task }) => task);
  const world = tasks.includes("drone") ? "drone" : tasks[0];
  const policies = data.policies.filter(({ task }) => task === world);
  const algorithms = [...new Set(policies.map(({ algorithm }) => algorithm))];
  const first = algorithms.map((one) => policies.find(({ algorithm }) => algorithm === one).key);
  const pilots = [YOU, first[0] ?? NOBODY, first[1] ?? NOBODY, RULE];
  const settings = Object.fromEntries(Object.entries(data.settings).map(([name, { first: value }]) => [name, value]));
  return { world, set: data.set, k: data.k, circles: null, ...settings, pilots, focus: 2, speed: 1, greedy: false, seed: 0 };
}

/** Show a race's world in the controls; find: an element by its id. */
function showWorld({ policies, settings, worlds }, race, find) {
  const { scene } = race;
  find("world").value = scene.world;
  for (const [name, { worlds: where, unit }] of Object.entries(settings)) {
    find(name).value = scene[name];
    find(name).closest("label").hidden = where.length > 0 && !where.includes(scene.world);
    say(find(`${name}-now`), `${short(scene[name])}${unit && ` ${unit}`}`);
  }
  find("k").closest("label").hidden = scene.world === "slalom";
  const faults = Object.entries(settings).filter(([name, { worlds: where }]) => !where.length && scene[name] > 0);
  say(find("faults-now"), faults.map(([name]) => `${name} ${short(scene[name])}`).join(", ") || "none");
  for (const option of find("pilot").options) option.disabled = option.value !== NOBODY && !race.canFly(option.value);
  const able = policies.some(({ key }) => race.canFly(key));
  say(find("told"), `${worlds[scene.world].told}${able ? "" : " No network here has learned that: you and the rule fly."}`);
  find("told").hidden = !find("told").textContent;
}
