/*
 * The instruments: the table of the race, and of the drone in focus its values, its slots and its hidden units.
 */

const ENDS = { "": "flying", collision: "crashed", goal: "arrived", "time-out": "time limit" };

/** A drone's pilot in a word, and more of it in another: ["PPO", "tanh"]. */
function nameOf(pilot, policies) {
  const policy = policies.find(({ key }) => key === pilot);
  if (policy) return [policy.algorithm.toUpperCase(), policy.name];
  return { [YOU]: ["You", "keys"], [NOBODY]: ["–", "out"] }[pilot] ?? ["Scripted", pilot];
}

/**
 * A colour for each pilot, the same for the same one: the rule of uavnav/colours.py, whose tables are `known` and `others`.
 * Black is the page's ink, which is bright in the dark.
 */
function coloursOf(pilots, policies, { known, others }, ink) {
  const found = new Map();
  let further = 0;
  for (const pilot of pilots) {
    const mine = known[policies.find(({ key }) => key === pilot)?.algorithm ?? pilot];
    const free = mine && ![...found.values()].includes(mine);
    if (!found.has(pilot)) found.set(pilot, free ? mine : others[further++ % others.length]);
  }
  return pilots.map((pilot) => found.get(pilot).replace("#000000", ink));
}

/** The way to the goal, from the drone at (x, y): a line, and a ring at its end so many px away. */
function drawWay(context, [x, y], [right, forward], away, colours) {
  const end = [x + away * right, y - away * forward];
  line(context, [[x, y], end], 1, colours.muted);
  ring(context, ...end, 5, 2, colours.fg);
}

/**
 * What a drone senses. Above, in its own frame: itself below, ahead of it up. Below, a bar a slot, the higher the nearer.
 * way: to the goal, if there is one: right, forward [-1 to 1] and away [px].
 */
function drawSlots(canvas, { world, slots, way, mine }) {
  const { context, width, height, colours } = fit(canvas);
  const scale = width / 2 / (1.05 * world.sensor_radius);
  const [x, y] = [width / 2, 1.05 * scale * world.sensor_radius];
  const pose = { x: 0, y: 0, angle: Math.PI / 2 };
  const sensed = sensedPoints(world, [0, 0], planeAxes(pose.angle), slots);
  context.save();
  context.beginPath();
  context.rect(0, 0, width, y);
  context.clip();
  context.transform(scale, 0, 0, -scale, x, y);
  drawFlight(context, world, { pose, trail: [], sensed, accent: mine }, 0.7 / scale, colours);
  context.restore();
  if (way) drawWay(context, [x, y], way, scale * Math.min(way[2], 0.9 * world.sensor_radius), colours);
  const foot = height - 15;
  const step = width / slots.length;
  context.font = `12px ${getComputedStyle(canvas).fontFamily}`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  slots.forEach((slot, place) => {
    context.fillStyle = isFilled(slot) ? colours.fg : colours.muted;
    const bar = isFilled(slot) ? Math.max(1, (1 - slot[2]) * (foot - y - 8)) : 0;
    context.fillRect((place + 0.15) * step, foot - bar, 0.7 * step, bar);
    context.fillText(String(place + 1), (place + 0.5) * step, foot + 9);
  });
  line(context, [[0, foot], [width, foot]], 1, colours.muted);
}

/** The hidden layers side by side, a square a unit. */
function drawUnits(canvas, layers) {
  const { context, width, height } = fit(canvas);
  const gap = 0.06 * width;
  const share = (width - gap * (layers.length - 1)) / layers.length;
  layers.forEach((units, layer) => {
    const columns = Math.ceil(Math.sqrt(units.length));
    const side = Math.min(share, height) / columns;
    const [low, high] = [Math.min(0, ...units), Math.max(...units)];
    units.forEach((unit, place) => {
      context.fillStyle = colourOf((unit - low) / (high - low || 1));
      const [column, row] = [place % columns, Math.floor(place / columns)];
      context.fillRect(layer * (share + gap) + column * side, row * side, side - 0.5, side - 0.5);
    });
  });
}

class Panel {
  /** data: the page's; find: an element by its id. */
  constructor(data, find) {
    Object.assign(this, { data, find });
    this.world = data.tasks.drone.world; // whose drone every world has
    this.actions = actionsOf(this.world);
    layOut(find("values"), this.actions);
    this.seats = [...document.querySelectorAll(".seat")];
    this.rows = [...document.querySelectorAll("[data-metric]")].map((row) => [
      data.metrics.find(({ name }) => name === row.dataset.metric),
      [...row.cells].slice(1),
    ]);
    this.states = [...document.querySelectorAll(".state td")];
  }

  /** Who flies which drone, and which is in focus; colours: of each pilot. */
  showSeats(race, focus, colours) {
    race.drones.forEach(({ pilot }, place) => {
      const [who, more] = nameOf(pilot, this.data.policies);
      const seat = this.seats[place];
      say(seat.querySelector(".who"), who);
      say(seat.querySelector("small"), more);
      seat.setAttribute("aria-pressed", String(place === focus));
      seat.style.setProperty("--mine", colours[place]);
      seat.style.setProperty("--ink", inkOn(colours[place]));
    });
  }

  showRace(race) {
    const most = Math.max(...race.flown.map(({ state }) => state.reward));
    race.drones.forEach(({ pilot, state, ended }, place) => {
      const away = !race.canFly(pilot);
      const waits = pilot === YOU && !race.begun && !ended;
      say(this.states[place], pilot === NOBODY ? "" : away ? "cannot fly" : waits ? "waiting" : ENDS[ended]);
      for (const [metric, cells] of this.rows) {
        const value = metricOf(metric, state);
        const decimals = metric.scale === null && metric.column !== "reward" ? 0 : metric.scale === 100 ? 0 : 1;
        say(cells[place], away ? "" : fixed(value, decimals));
        cells[place].classList.toggle("ahead", metric.column === "reward" && !away && state.steps > 0 && state.reward === most);
      }
    });
  }

  /** The instruments of one drone of a race. */
  showDrone(race, place, mine) {
    const drone = race.drones[place];
    const policy = race.policyOf(drone.pilot);
    const { action, shown, low, high, hidden = [] } = drone.thought;
    const chosen = race.canFly(drone.pilot) ? (action ?? encode(this.world, race.hand)) : undefined;
    const words = chosen === undefined ? "" : `: ${inWords(this.actions[chosen])}`;
    const subject = policy ? `${policy.shown} of each action, the chosen one framed` : "each action, the chosen one framed";
    say(this.find("values-title"), subject);
    const values = this.find("values");
    const shares = shown && ((one) => (shown[one] - low) / (high - low || 1));
    showValues(values, { shares, chosen, low, high });
    values.setAttribute("aria-label", `${subject}${words}`);
    const slots = slotsOf(this.world, drone.observation);
    const way = wayOf(this.world, drone.observation, race.task.rules.scale);
    const filled = slots.filter(isFilled).length;
    const sensor = this.find("sensor");
    drawSlots(sensor, { world: this.world, slots, way, mine });
    const goal = way ? `; the goal at ${fixed(way[2], 0)} px` : "";
    const edge = `; the nearest edge at ${fixed(drone.clearance, 0)} px${goal}`;
    sensor.setAttribute("aria-label", `${filled} of ${slots.length} slots filled${edge}`);
    say(this.find("sensor-title"), way ? "the ten slots it senses, and the way to the goal" : "the ten slots it senses");
    const said = hidden.length ? "its hidden units, the greater the brighter" : "hidden units: none";
    say(this.find("units-title"), said);
    drawUnits(this.find("units"), hidden);
  }
}
