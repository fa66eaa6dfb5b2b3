// Small plots over the episode. What does not move is drawn once into a picture of its own.

class Plot {
  // paint(context, width, height) draws what stands still; cursor(context, width, height) the rest.
  constructor(canvas, steps, paint, cursor, seek) {
    Object.assign(this, { canvas, steps, paint, cursor, still: null });
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

  resize() {
    this.still = null;
  }

  draw() {
    const { canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (!this.still) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
      this.still = document.createElement("canvas");
      [this.still.width, this.still.height] = [canvas.width, canvas.height];
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

function tidySteps(low, high, count) {
  const raw = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * [1, 2, 2.5, 5, 10].find((k) => k * power >= raw);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) ticks.push(k * step);
  return ticks;
}

const short = (x) => String(+x.toPrecision(3)).replace("-", "−");

// Lines [{ values, colour, width }] on a grid with numbers at the left.
function paintLines(context, width, height, lines, low, high, theme, extra) {
  const [x, y] = scales(width, height, lines[0].values.length - 1, low, high);
  context.font = "10.5px system-ui, sans-serif";
  context.textBaseline = "bottom";
  for (const tick of tidySteps(low, high, 3)) {
    context.fillStyle = css(theme.line);
    context.fillRect(0, Math.round(y(tick)), width, 1);
    context.fillStyle = css(theme.soft);
    context.fillText(short(tick), 1, y(tick) - 1);
  }
  if (extra) extra(context, x, y);
  context.lineJoin = "round";
  context.beginPath();
  context.rect(0, 0, width, height);
  context.clip();
  for (const { values: row, colour, width: thick } of lines) {
    context.strokeStyle = css(colour);
    context.lineWidth = thick;
    context.beginPath();
    for (let step = 0; step < row.length; step++) context.lineTo(x(step), y(row[step]));
    context.stroke();
  }
}

function scales(width, height, steps, low, high) {
  const inner = height - 20;
  return [(step) => (step / Math.max(steps, 1)) * (width - 2) + 1, (value) => 16 + inner * (1 - (value - low) / (high - low || 1))];
}

function range(rows) {
  let [low, high] = [Infinity, -Infinity];
  for (const row of rows) {
    for (const value of row) {
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  }
  return [Math.min(low, 0), Math.max(high, 0, low + 1e-9)];
}

function paintCursor(context, width, height, time, steps, theme) {
  context.fillStyle = css(theme.text, 0.55);
  context.fillRect((time / steps) * (width - 2) + 0.25, 0, 1.5, height);
}

function paintDot(context, x, y, colour, theme) {
  context.beginPath();
  context.arc(x, y, 3.6, 0, 2 * Math.PI);
  context.fillStyle = css(colour);
  context.fill();
  context.lineWidth = 1.5;
  context.strokeStyle = css(theme.panel);
  context.stroke();
}

// Reads a row of values between two steps.
function valueAt(row, time) {
  const step = Math.min(Math.floor(time), row.length - 1);
  return mix(row[step], row[Math.min(step + 1, row.length - 1)], time - step);
}

function makePlots(episode, state, seek) {
  const { steps, agents } = episode;
  const by = (id) => document.getElementById(id);
  const shown = episode.terms.map((_, k) => k).filter((k) => episode.earned[k].some((x) => x !== 0));
  // the bonus of the last step would flatten all others
  const [low, high] = range(shown.filter((k) => episode.terms[k] !== "success").map((k) => episode.earned[k]));
  const far = Math.max(...episode.distance) * 1.04;

  const distance = new Plot(by("p-distance"), steps, (context, width, height) => {
    const { theme } = state;
    paintLines(context, width, height, [{ values: episode.distance, colour: theme.accent, width: 1.8 }], 0, far, theme, (c, x, y) => {
      c.fillStyle = css(PAINT.reached, 0.2);
      c.fillRect(0, y(episode.successRadius), width, y(0) - y(episode.successRadius));
    });
  }, (context, width, height) => {
    paintCursor(context, width, height, state.time, steps, state.theme);
    const [x, y] = scales(width, height, steps, 0, far);
    paintDot(context, x(state.time), y(valueAt(episode.distance, state.time)), state.theme.accent, state.theme);
  }, seek);

  const terms = new Plot(by("p-terms"), steps, (context, width, height) => {
    const lines = shown.map((k) => ({ values: episode.earned[k], colour: SERIES[k % SERIES.length], width: 1.5 }));
    if (lines.length) paintLines(context, width, height, lines, low, high, state.theme);
  }, (context, width, height) => paintCursor(context, width, height, state.time, steps, state.theme), seek);

  const actions = new Plot(by("p-actions"), steps, (context, width, height) => {
    const picture = new ImageData(steps, agents);
    const gap = 12;
    for (let side = 0; side < 2; side++) {
      for (let step = 0; step < steps; step++) {
        for (let agent = 0; agent < agents; agent++) {
          const rgb = signed(episode.action[2 * (step * agents + agent) + side], state.theme);
          const at = 4 * ((agents - 1 - agent) * steps + step); // the tip's agent on top, as in the scene
          picture.data.set([...rgb.map((v) => Math.round(255 * v)), 255], at);
        }
      }
      const small = document.createElement("canvas");
      [small.width, small.height] = [steps, agents];
      small.getContext("2d").putImageData(picture, 0, 0);
      context.imageSmoothingEnabled = steps > width / 2;
      const half = (width - gap) / 2;
      context.drawImage(small, side * (half + gap), 0, half, height);
    }
    for (let agent = 0; agent < agents; agent++) {
      context.fillStyle = css(agentColour(agent, agents));
      context.fillRect(width / 2 - 2, (height * (agents - 1 - agent)) / agents + 1, 4, height / agents - 2);
    }
  }, (context, width, height) => {
    const half = (width - 12) / 2;
    context.fillStyle = css(state.theme.text);
    for (const left of [0, half + 12]) context.fillRect(left + (state.time / steps) * (half - 1.5), 0, 1.5, height);
  });

  // discoveries and contacts above the slider, whose thumb stays 8 px from its ends
  const events = new Plot(by("events"), steps, (context, width) => {
    const x = (step) => 8 + (step / steps) * (width - 16);
    const most = Math.max(...episode.touching);
    for (let step = 0; step <= steps; step++) {
      if (!episode.touching[step]) continue;
      const size = 3 + (6 * episode.touching[step]) / most;
      context.fillStyle = css(state.theme.touching, 0.8);
      context.fillRect(x(step) - 0.5, 12 - size, Math.max(1, (width - 16) / steps), size);
    }
    context.fillStyle = css(PAINT.discovered);
    for (const step of new Set(episode.slots.map((slot) => slot.step))) context.fillRect(x(step) - 0.75, 0, 2, 4);
  }, () => {});

  const legend = shown.map((k) => {
    const item = document.createElement("li");
    const swatch = document.createElement("i");
    const value = document.createElement("b");
    swatch.style.background = css(SERIES[k % SERIES.length]);
    item.append(swatch, episode.terms[k], value);
    by("legend").append(item);
    return { value, row: episode.earned[k] };
  });
  const plots = [distance, terms, actions, events];
  return {
    resize: () => plots.forEach((plot) => plot.resize()),
    draw: () => {
      plots.forEach((plot) => plot.draw());
      for (const { value, row } of legend) value.textContent = row[Math.floor(state.time)].toFixed(2).replace("-", "−");
    },
  };
}
