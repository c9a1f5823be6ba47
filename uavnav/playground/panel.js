/*
 * The instruments: the table of the race, and of the drone in focus its values, its slots and its hidden units.
 */

const BOUNDS = {
  tanh: [-1, 1], sigmoid: [0, 1], softsign: [-1, 1], hardtanh: [-1, 1], relu6: [0, 6], sigmoid_centred: [-1, 1],
}; // of activations that have some

/** A text of an element, written only where it is another. */
function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A drone's pilot in a word, and more of it in another: ["PPO", "tanh"]. */
function nameOf(pilot, policies) {
  const policy = policies.find(({ key }) => key === pilot);
  if (policy) return [policy.algorithm.toUpperCase(), policy.activation.replace("_", " ")];
  return { [YOU]: ["You", "keys"], [RULE]: ["Rule", "scripted"], [NOBODY]: ["–", "out"] }[pilot];
}

/**
 * What a drone senses. Above, in its own frame: itself below, ahead of it up. Below, a bar a slot, the higher the nearer.
 */
function drawSlots(canvas, { world, slots, mine, colours, font }) {
  const { context, width, height } = fit(canvas);
  const scale = width / 2 / (1.05 * world.sensor_radius);
  const [x, y] = [width / 2, 1.05 * scale * world.sensor_radius];
  const half = (radius) => {
    context.beginPath();
    context.arc(x, y, radius * scale, Math.PI, 2 * Math.PI);
    context.closePath();
  };
  half(world.sensor_radius);
  context.fillStyle = context.strokeStyle = mine;
  context.globalAlpha = 0.15;
  context.fill();
  context.globalAlpha = 1;
  context.lineWidth = 1;
  context.stroke();
  half(world.drone_radius);
  context.fill();
  const foot = height - 15;
  const step = width / slots.length;
  context.font = font;
  context.textAlign = "center";
  context.textBaseline = "middle";
  slots.forEach(([right, forward, proximity], place) => {
    const filled = right !== 0 || forward !== 0;
    const reach = scale * (world.drone_radius + proximity * (world.sensor_radius - world.drone_radius));
    context.fillStyle = colours.fg;
    if (filled) {
      line(context, [[x, y], [x + reach * right, y - reach * forward]], 1, colours.fg);
      disc(context, x + reach * right, y - reach * forward, 3.5);
    }
    const bar = filled ? Math.max(1, (1 - proximity) * (foot - y - 8)) : 0;
    context.fillRect((place + 0.15) * step, foot - bar, 0.7 * step, bar);
    context.fillStyle = filled ? colours.fg : colours.muted;
    context.fillText(String(place + 1), (place + 0.5) * step, foot + 9);
  });
  line(context, [[0, foot], [width, foot]], 1, colours.muted);
}

/** The hidden layers side by side, a square a unit. */
function drawUnits(canvas, { layers, ranges, colours, font }) {
  const { context, width, height } = fit(canvas);
  context.font = font;
  const gap = 0.06 * width;
  const share = (width - gap * (layers.length - 1)) / layers.length;
  layers.forEach((units, layer) => {
    const columns = Math.ceil(Math.sqrt(units.length));
    const side = Math.min(share, height) / columns;
    const [low, high] = ranges[layer];
    units.forEach((unit, place) => {
      context.fillStyle = colourOf((unit - low) / (high - low || 1));
      const [column, row] = [place % columns, Math.floor(place / columns)];
      context.fillRect(layer * (share + gap) + column * side, row * side, side - 0.5, side - 0.5);
    });
  });
  if (layers.length) return;
  context.fillStyle = colours.muted;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText("none", width / 2, height / 2);
}

class Panel {
  /** data: the page's; find: an element by its id. */
  constructor(data, find) {
    Object.assign(this, { data, find });
    const { n_turns, n_distances } = data.world;
    this.actions = Array.from({ length: n_turns * n_distances }, (_, action) => decode(data.world, action));
    this.grid = gridOf(this.actions);
    this.seats = [...document.querySelectorAll(".seat")];
    this.rows = [...document.querySelectorAll("[data-metric]")].map((row) => [
      data.metrics.find(({ name }) => name === row.dataset.metric),
      [...row.cells].slice(1),
    ]);
    this.states = [...document.querySelectorAll(".state td")];
  }

  /** Who flies which drone, and which is in focus. */
  showSeats(race, focus) {
    race.drones.forEach(({ pilot }, place) => {
      const [who, more] = nameOf(pilot, this.data.policies);
      const seat = this.seats[place];
      say(seat.querySelector(".who"), who);
      say(seat.querySelector("small"), more);
      seat.setAttribute("aria-pressed", String(place === focus));
    });
  }

  showRace(race) {
    const inRace = race.drones.filter(({ pilot }) => pilot !== NOBODY);
    const most = Math.max(...inRace.map(({ state }) => state.reward));
    race.drones.forEach(({ pilot, state, crashed }, place) => {
      const away = pilot === NOBODY;
      say(this.states[place], away ? "" : crashed ? "crashed" : "flying");
      for (const [metric, cells] of this.rows) {
        const value = metricOf(metric, state);
        const decimals = metric.scale === null && metric.column !== "reward" ? 0 : metric.scale === 100 ? 0 : 1;
        say(cells[place], away ? "" : fixed(value, decimals));
        cells[place].classList.toggle("ahead", metric.column === "reward" && !away && state.steps > 0 && state.reward === most);
      }
    });
  }

  /** The instruments of one drone; hand: what a person steers. */
  showDrone(drone, place, hand, colours, font) {
    const policy = this.data.policies.find(({ key }) => key === drone.pilot);
    const { action, shown, low, high, hidden = [] } = drone.thought;
    const chosen = drone.pilot === NOBODY ? undefined : (action ?? encode(this.data.world, hand));
    const words = chosen === undefined ? "" : `: ${inWords(this.actions[chosen])}`;
    const subject = policy ? `${policy.shown} of each action, the chosen one framed` : "each action, the chosen one framed";
    say(this.find("values-title"), subject);
    const values = this.find("values");
    const shares = shown && ((one) => (shown[one] - low) / (high - low || 1));
    drawValues(values, { grid: this.grid, colours, font, instead: "", shares, chosen, low, high });
    values.setAttribute("aria-label", `${subject}${words}`);
    const slots = slotsOf(drone.observation);
    const filled = slots.filter(([right, forward]) => right !== 0 || forward !== 0).length;
    const sensor = this.find("sensor");
    drawSlots(sensor, { world: this.data.world, slots, mine: colours[`drone-${place + 1}`], colours, font });
    sensor.setAttribute("aria-label", `${filled} of ${slots.length} slots filled; the nearest edge at ${fixed(drone.clearance, 0)} px`);
    this.showUnits(policy, hidden, colours, font);
  }

  showUnits(policy, hidden, colours, font) {
    const bounds = policy && BOUNDS[policy.activation];
    const ranges = hidden.map((units) => bounds ?? [Math.min(0, ...units), Math.max(...units)]);
    const high = ranges.map((range) => short(range[1])).join(" and ");
    const units = this.find("units");
    drawUnits(units, { layers: hidden, ranges, colours, font });
    const words = bounds ? `from ${short(bounds[0])} to ${short(bounds[1])}` : `up to ${high}`;
    const said = hidden.length ? `its hidden units, ${words}` : "hidden units: none";
    say(this.find("units-title"), said);
    units.setAttribute("aria-label", said);
  }
}
