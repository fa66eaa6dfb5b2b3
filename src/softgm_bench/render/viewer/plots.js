// Small plots over the episode. What does not move is drawn once into a picture of its own.

class Plot {
  // paint(context, width, height) draws what stands still; cursor(context, width, height) the rest.
  constructor(canvas, steps, paint, cursor, seek) {
    Object.assign(this, { canvas, paint, cursor, still: null });
    if (!seek) return;
    const go = (event) => {
      const box = canvas.getBoundingClientRect();
      seek(clamp(Math.round(((event.clientX - box.left) / box.width) * steps), 0, steps));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      go(event);
    });
    canvas.addEventListener("pointermove", (event) => event.buttons && go(event));
  }

  resize() { this.still = null; }

  draw() {
    const { canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (!this.still) {
      const size = { width: Math.round(width * ratio), height: Math.round(height * ratio) };
      Object.assign(canvas, size);
      this.still = Object.assign(document.createElement("canvas"), size);
      const context = this.still.getContext("2d");
      context.scale(ratio, ratio);
      this.paint(context, width, height);
    }
    const context = canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.drawImage(this.still, 0, 0);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.cursor(context, width, height);
  }
}

function tidySteps(low, high, wanted) {
  const raw = (high - low) / wanted || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 2.5, 5, 10].find((k) => k * power >= raw);
  const first = Math.ceil(low / step - 1e-9);
  return count(Math.floor(high / step + 1e-9) - first + 1).map((k) => (first + k) * step);
}

const minus = (text) => text.replace("-", "−");

const scales = (width, height, steps, low, high) => [
  (step) => (step / steps) * (width - 2) + 1,
  (value) => 16 + (height - 20) * (1 - (value - low) / (high - low || 1)),
];

// Lines [{ values, colour, width }] on a grid with numbers at the left.
function paintLines(context, width, height, lines, low, high, theme, extra) {
  const [x, y] = scales(width, height, lines[0].values.length - 1, low, high);
  context.font = "10.5px system-ui, sans-serif";
  context.textBaseline = "bottom";
  for (const tick of tidySteps(low, high, 3)) {
    context.fillStyle = css(theme.line);
    context.fillRect(0, Math.round(y(tick)), width, 1);
    context.fillStyle = css(theme.soft);
    context.fillText(minus(String(+tick.toPrecision(3))), 1, y(tick) - 1);
  }
  if (extra) extra(y);
  context.lineJoin = "round";
  context.beginPath();
  context.rect(0, 0, width, height);
  context.clip();
  for (const { values, colour, width: thick } of lines) {
    context.strokeStyle = css(colour);
    context.lineWidth = thick;
    context.beginPath();
    values.forEach((value, step) => context.lineTo(x(step), y(value)));
    context.stroke();
  }
}

function makePlots(episode, state, seek) {
  const { agents, distance, earned, steps, touching } = episode;
  const shown = count(earned.length).filter((k) => earned[k].some((x) => x !== 0));
  // the bonus of the last step would flatten all others
  const ordinary = shown.filter((k) => episode.terms[k] !== "success").flatMap((k) => earned[k]);
  const [low, high] = [Math.min, Math.max].map((pick) => ordinary.reduce((most, value) => pick(most, value), 0));
  const far = Math.max(...distance) * 1.04;
  const colour = (k) => SERIES[k % SERIES.length];
  const cursor = (context, width, height) => {
    context.fillStyle = css(state.theme.text, 0.55);
    context.fillRect((state.time / steps) * (width - 2) + 0.25, 0, 1.5, height);
  };

  const way = new Plot(by("p-distance"), steps, (context, width, height) => {
    const { theme } = state;
    paintLines(context, width, height, [{ values: distance, colour: theme.accent, width: 1.8 }], 0, far, theme, (y) => {
      context.fillStyle = css(PAINT.reached, 0.2);
      context.fillRect(0, y(episode.successRadius), width, y(0) - y(episode.successRadius));
    });
  }, (context, width, height) => {
    cursor(context, width, height);
    const [x, y] = scales(width, height, steps, 0, far);
    const step = Math.min(Math.floor(state.time), steps - 1);
    const now = mix(distance[step], distance[step + 1], state.time - step);
    disc(context, x(state.time), y(now), 3.6, state.theme.accent, state.theme.panel, 1.5);
  }, seek);

  const terms = new Plot(by("p-terms"), steps, (context, width, height) => {
    const lines = shown.map((k) => ({ values: earned[k], colour: colour(k), width: 1.5 }));
    if (lines.length) paintLines(context, width, height, lines, low, high, state.theme);
  }, cursor, seek);

  const gap = 12; // between the pictures of both components
  const actions = new Plot(by("p-actions"), steps, (context, width, height) => {
    const half = (width - gap) / 2;
    context.imageSmoothingEnabled = steps > width / 2;
    for (const side of [0, 1]) {
      const small = Object.assign(document.createElement("canvas"), { width: steps, height: agents });
      const ink = small.getContext("2d");
      for (const [agent, step] of count(agents).flatMap((agent) => count(steps).map((step) => [agent, step]))) {
        const value = episode.action[2 * (step * agents + agent) + side];
        for (const fill of [css(state.theme.line), css(value < 0 ? NEGATIVE : POSITIVE, Math.min(1, Math.abs(value)))]) {
          ink.fillStyle = fill;
          ink.fillRect(step, agents - 1 - agent, 1, 1); // the tip's agent on top, as in the scene
        }
      }
      context.drawImage(small, side * (half + gap), 0, half, height);
    }
    for (let agent = 0; agent < agents; agent++) {
      context.fillStyle = css(agentColour(agent, agents));
      context.fillRect(width / 2 - 2, (height * (agents - 1 - agent)) / agents + 1, 4, height / agents - 2);
    }
  }, (context, width, height) => {
    const half = (width - gap) / 2;
    context.fillStyle = css(state.theme.text);
    for (const left of [0, half + gap]) context.fillRect(left + (state.time / steps) * (half - 1.5), 0, 1.5, height);
  });

  // discoveries and contacts above the slider, whose thumb stays 8 px from its ends
  const events = new Plot(by("events"), steps, (context, width) => {
    const x = (step) => 8 + (step / steps) * (width - 16);
    const most = Math.max(...touching);
    context.fillStyle = css(state.theme.touching, 0.8);
    touching.forEach((nodes, step) => {
      const size = 3 + (6 * nodes) / most;
      if (nodes) context.fillRect(x(step) - 0.5, 12 - size, Math.max(1, (width - 16) / steps), size);
    });
    context.fillStyle = css(PAINT.discovered);
    for (const step of new Set(episode.slots.map((slot) => slot.step))) context.fillRect(x(step) - 0.75, 0, 2, 4);
  }, () => {});

  const legend = shown.map((k) => {
    const [item, swatch, value] = ["li", "i", "b"].map((tag) => document.createElement(tag));
    swatch.style.background = css(colour(k));
    item.append(swatch, episode.terms[k], value);
    by("legend").append(item);
    return () => (value.textContent = minus(earned[k][Math.floor(state.time)].toFixed(2)));
  });
  return [way, terms, actions, events, { draw: () => legend.forEach((write) => write()), resize: () => {} }];
}

function disc(context, x, y, radius, colour, rim, thick) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = css(colour);
  context.fill();
  context.lineWidth = thick;
  context.strokeStyle = css(rim);
  context.stroke();
}
