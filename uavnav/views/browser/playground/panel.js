/*
 * The instruments: the table of the race, and of the drone in focus its values, slots and hidden units.
 */

const ENDS = { "": "flying", collision: "crashed", goal: "arrived", "time-out": "time limit" };

/** A drone's pilot in a word, and more of it in another: ["PPO", "tanh"]. */
function nameOf(pilot, policies) {
  const policy = policies.find(({ key }) => key === pilot);
  if (policy) return [policy.algorithm.toUpperCase(), policy.name];
  return { [YOU]: ["You", "keys"], [NOBODY]: ["–", "out"] }[pilot] ?? ["Scripted", pilot];
}

/**
 * A colour for each pilot, the same for the same one: the rule of uavnav/colours.py, whose tables are `known`
 * and `others`. Black is the page's ink, which is bright in the dark.
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

/**
 * What a drone senses, in its own frame: itself in the middle, ahead of it up, and nothing behind it but the
 * way to the goal, if there is one: right, forward [-1 to 1] and away [px].
 */
function drawSlots(canvas, { world, slots, way, mine }) {
  const { context, width, colours } = fit(canvas);
  const side = 1.05 * world.sensor_radius;
  const scale = width / 2 / side;
  const pose = { x: 0, y: 0, angle: Math.PI / 2 };
  const sensed = sensedPoints(world, [0, 0], planeAxes(pose.angle), slots);
  context.transform(scale, 0, 0, -scale, width / 2, width / 2);
  drawEpisode(context, world, { pose, trail: [], sensed, accent: mine }, 0.7 / scale, colours);
  context.clearRect(-side, 0, 2 * side, -side);
  if (!way) return;
  const away = Math.min(way[2], 0.9 * world.sensor_radius);
  const end = [away * way[0], away * way[1]];
  line(context, [[0, 0], end], 1 / scale, colours.muted);
  ring(context, ...end, 5 / scale, 2 / scale, colours.fg);
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
    this.seats = [...document.querySelectorAll(".seat")];
    this.rows = [...document.querySelectorAll("[data-metric]")];
    this.states = [...document.querySelectorAll(".state td")];
    this.bars = [...document.querySelectorAll("#slots li")];
  }

  /** Who flies which drone, which is in focus, and how they fare; colours: of each pilot. */
  showRace(race, focus, colours) {
    const most = Math.max(...race.piloted.map(({ state }) => state.reward));
    race.drones.forEach(({ pilot, state, ended }, place) => {
      const [who, more] = nameOf(pilot, this.data.policies);
      const seat = this.seats[place];
      say(seat.querySelector(".who"), who);
      say(seat.querySelector("small"), more);
      seat.setAttribute("aria-pressed", String(place === focus));
      seat.style.setProperty("--mine", colours[place]);
      seat.style.setProperty("--ink", inkOn(colours[place]));
      const away = !race.canFly(pilot);
      const waits = pilot === YOU && !race.begun && !ended;
      say(this.states[place], pilot === NOBODY ? "" : away ? "cannot fly" : waits ? "waiting" : ENDS[ended]);
      this.data.metrics.forEach((metric, nth) => {
        const cell = this.rows[nth].cells[place + 1];
        const isReward = metric.column === "reward";
        say(cell, away ? "" : fixed(metricOf(metric, state), isReward || metric.scale === 1 ? 1 : 0));
        cell.classList.toggle("ahead", isReward && !away && state.steps > 0 && state.reward === most);
      });
    });
  }

  /** The instruments of one drone of a race. */
  showDrone(race, place, mine) {
    const drone = race.drones[place];
    const policy = race.policyOf(drone.pilot);
    const { action, shown, low, high, hidden = [] } = drone.thought;
    const chosen = race.canFly(drone.pilot) ? (action ?? encode(this.world, race.hand)) : undefined;
    const words = chosen === undefined ? "" : `: ${inWords(this.actions[chosen])}`;
    const subject = `${policy ? `${policy.shown} of ` : ""}each action, the chosen one framed`;
    say(this.find("values-title"), subject);
    const values = this.find("values");
    const shares = shown && ((one) => (shown[one] - low) / (high - low || 1));
    showValues(values, { shares, chosen, low, high });
    values.setAttribute("aria-label", `${subject}${words}`);
    const slots = slotsOf(this.world, drone.observation);
    const way = wayOf(this.world, drone.observation, race.task.needs.scale);
    const filled = slots.filter(isFilled).length;
    const sensor = this.find("sensor");
    drawSlots(sensor, { world: this.world, slots, way, mine });
    slots.forEach((slot, place) => {
      this.bars[place].classList.toggle("filled", isFilled(slot));
      this.bars[place].style.setProperty("--near", 1 - slot[2]);
    });
    const goal = way ? `; the goal at ${fixed(way[2], 0)} px` : "";
    const edge = `; the nearest edge at ${fixed(drone.clearance, 0)} px${goal}`;
    sensor.setAttribute("aria-label", `${filled} of ${slots.length} slots filled${edge}`);
    say(this.find("sensor-title"), `the ten slots it senses${way ? ", and the way to the goal" : ""}`);
    const said = hidden.length ? "its hidden units, the greater the brighter" : "hidden units: none";
    say(this.find("units-title"), said);
    drawUnits(this.find("units"), hidden);
  }
}
