// The page: state, controls, and drawing when something has changed.

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8, 16];

function main() {
  const by = (id) => document.getElementById(id);
  const episode = readEpisode();
  readPaint(episode.colours);
  const bounds = sceneBounds(episode);
  const canvas = by("scene");
  const camera = new Camera(episode.camera, bounds.points);
  const show = { edges: true, actions: true, path: true, labels: true, clear: episode.wall };
  const state = { time: 0, playing: false, speed: 1, theme: readTheme(), choice: { stage: null, layer: null, head: null }, show };
  const hash = new URLSearchParams(location.hash.slice(1));
  let renderer = chooseRenderer(canvas, episode, bounds, hash.get("renderer") === "2d");
  let waiting = false;
  let before = null;
  let ratio = 1;

  function changed() {
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(tick);
    }
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
    const rod = rodAt(episode, state.time);
    const frame = {
      rod,
      reached: episode.success && state.time >= episode.steps,
      solids: solidsAt(episode, rod, state.time, bounds, state.theme, show),
      path: show.path ? pathAt(episode, state.time) : [],
      edges: show.edges ? edgesAt(episode, rod, state.time, state.theme, state.choice, camera.out) : [],
    };
    renderer.draw(frame, camera, state.theme, ratio);
    drawLabels(by("overlay"), episode, rod, camera, state, ratio);
    readOuts(episode, state);
    plots.draw();
    matrix.draw();
  }

  function seek(time) {
    setPlaying(false);
    state.time = clamp(time, 0, episode.steps);
    speak(episode, state);
    changed();
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
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    for (const one of [canvas, by("overlay")]) {
      one.width = Math.max(1, Math.round(width * ratio));
      one.height = Math.max(1, Math.round(height * ratio));
    }
    const header = document.querySelector("header").offsetHeight;
    camera.resize(width, height, [Math.min(header + 16, 0.3 * height), 20, 34, 20]);
    plots.resize();
    matrix.resize();
    changed();
  }

  const plots = makePlots(episode, state, seek);
  const matrix = makeMatrix(episode, state, changed);

  by("time").max = episode.steps;
  by("time").addEventListener("input", (event) => seek(Number(event.target.value)));
  by("play").addEventListener("click", () => setPlaying(!state.playing));
  chooseSpeeds(by("speed"), episode, state);
  for (const name of Object.keys(show)) {
    by(`s-${name}`).checked = show[name];
    by(`s-${name}`).addEventListener("change", (event) => {
      show[name] = event.target.checked;
      changed();
    });
  }
  const views = { home: [], front: [Math.PI, 0.12], side: [-Math.PI / 2, 0.12], top: [-Math.PI / 2, 1.5] };
  for (const [name, angles] of Object.entries(views)) {
    by(`view-${name}`).addEventListener("click", () => {
      camera.reset(...angles);
      changed();
    });
  }
  listenForCamera(canvas, camera, changed);
  listenForKeys({ episode, state, camera, seek, setPlaying, changed });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    renderer = new GlRenderer(canvas, episode, bounds);
    changed();
  });
  new ResizeObserver(resize).observe(document.querySelector(".stage"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    state.theme = readTheme();
    resize();
  });
  describe(episode);
  state.time = clamp(Number(hash.get("step")) || 0, 0, episode.steps);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches || hash.has("step");
  resize();
  setPlaying(!still);
}

function chooseRenderer(canvas, episode, bounds, flat) {
  if (!flat) {
    try {
      return new GlRenderer(canvas, episode, bounds);
    } catch (error) {
      console.warn(error.message);
    }
  }
  const notice = document.getElementById("notice");
  notice.hidden = false;
  notice.textContent = "Simple drawing: this browser offers no WebGL 2 here.";
  return new FlatRenderer(canvas, episode);
}

function chooseSpeeds(select, episode, state) {
  for (const speed of SPEEDS) select.add(new Option(`${speed}×`, speed));
  // an episode lasts about eight seconds
  const wanted = (episode.steps * episode.controlDt) / 8;
  state.speed = SPEEDS.reduce((best, s) => (Math.abs(Math.log(s / wanted)) < Math.abs(Math.log(best / wanted)) ? s : best));
  select.value = state.speed;
  select.addEventListener("change", () => (state.speed = Number(select.value)));
}

function listenForKeys({ episode, state, camera, seek, setPlaying, changed }) {
  const zoom = (factor) => {
    camera.zoom(factor);
    changed();
  };
  const actions = {
    ArrowRight: (size) => seek(Math.floor(state.time + 1e-6) + size),
    ArrowLeft: (size) => seek(Math.ceil(state.time - 1e-6) - size),
    Home: () => seek(0),
    End: () => seek(episode.steps),
    r: () => {
      camera.reset();
      changed();
    },
    "+": () => zoom(0.87),
    "=": () => zoom(0.87),
    "-": () => zoom(1.15),
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const at = event.target;
    if (at instanceof HTMLSelectElement) return;
    if (event.key === " ") {
      if (at instanceof HTMLButtonElement || at.type === "checkbox") return; // these have a use for it
      setPlaying(!state.playing);
    } else {
      const action = actions[event.key] || actions[event.key.toLowerCase()];
      if (!action) return;
      action(event.shiftKey ? 10 : 1);
    }
    event.preventDefault();
  });
}

// texts

const OUTCOMES = { success: "Target reached", diverged: "Simulation diverged", open: "Target not reached" };

function outcomeOf(episode) {
  return episode.diverged ? "diverged" : episode.success ? "success" : "open";
}

function describe(episode) {
  const outcome = document.getElementById("outcome");
  const seconds = (episode.steps * episode.controlDt).toFixed(2);
  outcome.classList.add(outcomeOf(episode));
  outcome.textContent = `${OUTCOMES[outcomeOf(episode)]} after ${episode.steps} steps, ${seconds} s`;
  document.getElementById("scene").setAttribute(
    "aria-label",
    `Soft arm of ${episode.agents} sections, task ${episode.task}, ${episode.cylinders.length} obstacles. ${outcome.textContent}.`,
  );
}

const millimetres = (metres) => `${(1000 * metres).toFixed(0)} mm`;
const minus = (text) => text.replace("-", "−");

function readOuts(episode, state) {
  const by = (id) => document.getElementById(id);
  const step = Math.floor(state.time);
  const found = episode.slots.filter((slot) => slot.step <= step).length;
  by("time").value = step;
  by("time").setAttribute("aria-valuetext", `step ${step} of ${episode.steps}`);
  const seconds = document.createElement("small");
  seconds.textContent = `${(state.time * episode.controlDt).toFixed(2)} s`;
  by("clock").replaceChildren(`${step} / ${episode.steps}`, seconds);
  by("n-distance").textContent = millimetres(episode.distance[step]);
  by("n-reward").textContent = step ? minus(episode.reward[step - 1].toFixed(2)) : "–";
  by("n-return").textContent = minus(episode.returned[step].toFixed(1));
  by("n-contact").textContent = episode.touching[step];
  by("n-bins").textContent = found;
  by("c-distance").textContent = `success below ${millimetres(episode.successRadius)}`;
}

function speak(episode, state) {
  const step = Math.floor(state.time);
  document.getElementById("spoken").textContent =
    `Step ${step} of ${episode.steps}: ${millimetres(episode.distance[step])} to the target, ${episode.touching[step]} nodes in contact.`;
}

function drawLabels(canvas, episode, rod, camera, state, ratio) {
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, canvas.width, canvas.height);
  if (!state.show.labels) return;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.font = "600 10.5px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  episode.agentNodes.forEach((node, agent) => {
    const frame = frameAt(rod, node, episode.elements);
    const [x, y, depth] = camera.project(frame.centre);
    if (depth < NEAR) return;
    const colour = agentColour(agent, episode.agents);
    context.beginPath();
    context.arc(x, y, 8, 0, 2 * Math.PI);
    context.fillStyle = "#ffffff";
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = css(mixed(colour, [0, 0, 0], 0.15));
    context.stroke();
    context.fillStyle = "#1b2430";
    context.fillText(String(agent + 1), x, y + 0.5);
  });
}

main();
