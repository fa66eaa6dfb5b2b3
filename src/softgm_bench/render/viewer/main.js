// The page: state, controls, and drawing when something has changed.

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8, 16];

async function main() {
  const episode = await readEpisode();
  readPaint(episode.colours);
  const canvas = by("scene");
  const view = new View(canvas, episode, changed);
  const show = { edges: true, actions: true, path: true, labels: true, clear: episode.wall };
  const state = { time: 0, playing: false, speed: 1, theme: readTheme(), choice: { stage: null, layer: null, head: null }, show };
  const hash = new URLSearchParams(location.hash.slice(1));
  const flat = hash.get("renderer") === "2d" || !document.createElement("canvas").getContext("webgl2");
  const scene = flat ? null : new ArmScene(canvas, episode, view);
  by("notice").hidden = !flat;
  let [waiting, before, ratio] = [false, null, 1];

  function changed() {
    if (!waiting) requestAnimationFrame(tick);
    waiting = true;
  }

  function tick(now) {
    waiting = false;
    if (state.playing) {
      const passed = before === null ? 0 : Math.min(0.1, (now - before) / 1000);
      before = now;
      state.time = Math.min(episode.steps, state.time + (passed * state.speed) / episode.controlDt);
      if (state.time >= episode.steps) setPlaying(false);
      else changed();
    }
    draw();
  }

  function draw() {
    const { theme, time } = state;
    const rod = rodAt(episode, time);
    const out = view.camera.position.clone().sub(view.controls.target).normalize();
    const path = show.path ? pathAt(episode, time) : [];
    const edges = show.edges ? edgesAt(episode, rod, time, theme, state.choice, out) : [];
    const context = by("overlay").getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, view.width, view.height);
    if (scene) scene.draw(time, rod, [...path, ...edges], theme, show, ratio);
    else drawFlat(context, episode, rod, time, view);
    if (show.labels) drawLabels(context, episode, rod, view);
    readOuts(episode, state);
    for (const plot of plots) plot.draw();
  }

  function seek(time) {
    state.time = clamp(time, 0, episode.steps);
    setPlaying(false);
  }

  function setPlaying(playing) {
    if (playing && state.time >= episode.steps) state.time = 0;
    state.playing = playing;
    before = null;
    by("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    by("play-shape").setAttribute("d", playing ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
    if (!playing) speak(episode, state);
    changed();
  }

  function resize() {
    ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.max(1, canvas.clientWidth), Math.max(1, canvas.clientHeight)];
    Object.assign(by("overlay"), { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    const header = document.querySelector("header").offsetHeight;
    view.resize(width, height, [Math.min(header + 16, 0.3 * height), 20, 34, 20]);
    for (const plot of plots) plot.resize();
    draw();
  }

  const plots = [...makePlots(episode, state, seek), ...makeMatrix(episode, state, changed)];

  by("time").max = episode.steps;
  by("time").addEventListener("input", (event) => seek(Number(event.target.value)));
  by("play").addEventListener("click", () => setPlaying(!state.playing));
  chooseSpeeds(by("speed"), episode, state);
  for (const name of Object.keys(show)) {
    by(`s-${name}`).checked = show[name];
    by(`s-${name}`).addEventListener("change", (event) => changed((show[name] = event.target.checked)));
  }
  const views = { home: [], front: [Math.PI, 0.12], side: [-Math.PI / 2, 0.12], top: [-Math.PI / 2, 1.5] };
  for (const [name, angles] of Object.entries(views)) by(`view-${name}`).addEventListener("click", () => view.reset(...angles));
  listenForKeys({ episode, state, view, seek, setPlaying });
  canvas.addEventListener("webglcontextrestored", changed);
  new ResizeObserver(resize).observe(document.querySelector(".stage"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => resize((state.theme = readTheme())));
  describe(episode);
  state.time = clamp(Number(hash.get("step")) || 0, 0, episode.steps);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches || hash.has("step");
  resize();
  setPlaying(!still);
}

function chooseSpeeds(select, episode, state) {
  for (const speed of SPEEDS) select.add(new Option(`${speed}×`, speed));
  // an episode lasts about eight seconds
  const wanted = (episode.steps * episode.controlDt) / 8;
  state.speed = SPEEDS.reduce((best, s) => (Math.abs(Math.log(s / wanted)) < Math.abs(Math.log(best / wanted)) ? s : best));
  select.value = state.speed;
  select.addEventListener("change", () => (state.speed = Number(select.value)));
}

function listenForKeys({ episode, state, view, seek, setPlaying }) {
  const actions = {
    ArrowRight: (size) => seek(Math.floor(state.time + 1e-6) + size),
    ArrowLeft: (size) => seek(Math.ceil(state.time - 1e-6) - size),
    " ": () => setPlaying(!state.playing),
    Home: () => seek(0),
    End: () => seek(episode.steps),
    r: () => view.reset(),
    "+": () => view.zoom(0.87),
    "=": () => view.zoom(0.87),
    "-": () => view.zoom(1.15),
  };
  document.addEventListener("keydown", (event) => {
    const at = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey || at instanceof HTMLSelectElement) return;
    if (event.key === " " && (at instanceof HTMLButtonElement || at.type === "checkbox")) return; // these have a use for it
    const action = actions[event.key] || actions[event.key.toLowerCase()];
    if (!action) return;
    action(event.shiftKey ? 10 : 1);
    event.preventDefault();
  });
}

// texts

const OUTCOMES = { success: "Target reached", diverged: "Simulation diverged", open: "Target not reached" };

function describe(episode) {
  const outcome = by("outcome");
  const ending = episode.diverged ? "diverged" : episode.success ? "success" : "open";
  const seconds = (episode.steps * episode.controlDt).toFixed(2);
  outcome.classList.add(ending);
  outcome.textContent = `${OUTCOMES[ending]} after ${episode.steps} steps, ${seconds} s`;
  const scene = `Soft arm of ${episode.agents} sections, task ${episode.task}, ${episode.cylinders.length} obstacles.`;
  by("scene").setAttribute("aria-label", `${scene} ${outcome.textContent}.`);
}

const millimetres = (metres) => `${(1000 * metres).toFixed(0)} mm`;

function readOuts(episode, state) {
  const step = Math.floor(state.time);
  by("time").value = step;
  by("time").setAttribute("aria-valuetext", `step ${step} of ${episode.steps}`);
  const seconds = Object.assign(document.createElement("small"), { textContent: `${(state.time * episode.controlDt).toFixed(2)} s` });
  by("clock").replaceChildren(`${step} / ${episode.steps}`, seconds);
  const texts = {
    "n-distance": millimetres(episode.distance[step]),
    "n-reward": step ? minus(episode.reward[step - 1].toFixed(2)) : "–",
    "n-return": minus(episode.returned[step].toFixed(1)),
    "n-contact": episode.touching[step],
    "n-bins": episode.slots.filter((slot) => slot.step <= step).length,
    "c-distance": `success below ${millimetres(episode.successRadius)}`,
  };
  for (const [id, text] of Object.entries(texts)) by(id).textContent = text;
}

function speak(episode, state) {
  const step = Math.floor(state.time);
  by("spoken").textContent =
    `Step ${step} of ${episode.steps}: ${millimetres(episode.distance[step])} to the target, ${episode.touching[step]} nodes in contact.`;
}

// Without WebGL: thick strokes with round ends, one over the other.
function drawFlat(context, episode, rod, time, view) {
  const stroke = (start, end, radius, colour) => {
    const [a, b] = [view.project(start), view.project(along(end, UP, 1e-4))]; // a stroke without length is none
    if (Math.min(a.metres, b.metres) <= 0) return;
    Object.assign(context, { lineCap: "round", lineWidth: (2 * radius) / a.metres, strokeStyle: colour });
    context.stroke(new Path2D(`M${a.x} ${a.y}L${b.x} ${b.y}`));
  };
  episode.cylinders.forEach((cylinder, c) => {
    const start = shiftAt(episode, c, time).add(cylinder.start);
    stroke(start, along(start, cylinder.axis, cylinder.length), cylinder.radius, css(PAINT.column, 0.5));
  });
  rod.slice(1).forEach((node, i) => stroke(rod[i].centre, node.centre, node.radius, css(gradient(PAINT.arm, i / rod.length))));
  stroke(episode.target, episode.target, episode.successRadius, css(PAINT.target, 0.6));
}

function drawLabels(context, episode, rod, view) {
  Object.assign(context, { font: "600 10.5px system-ui, sans-serif", textAlign: "center", textBaseline: "middle" });
  const [white, ink] = [new Color("#ffffff"), new Color("#1b2430")];
  episode.agentNodes.forEach((node, agent) => {
    const { x, y, metres } = view.project(rod[node].centre);
    if (metres <= 0) return;
    disc(context, x, y, 8, white, mixed(agentColour(agent, episode.agents), ink, 0.2), 2);
    context.fillStyle = css(ink);
    context.fillText(String(agent), x, y + 0.5);
  });
}

main();
