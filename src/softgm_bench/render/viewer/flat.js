// The scene without WebGL: strokes on a 2D canvas, the far ones first. A thick stroke with round ends is a capsule.

class FlatRenderer {
  constructor(canvas, episode) {
    Object.assign(this, { canvas, episode, context: canvas.getContext("2d") });
  }

  draw(frame, view, theme, ratio) {
    const { context, canvas, episode } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = css(theme.back);
    context.fillRect(0, 0, canvas.width, canvas.height);
    const strokes = [];
    const stroke = (a, b, radius, colour, cap = "round") => {
      const [p, q] = [view.project(a), view.project(b)];
      const depth = (p[2] + q[2]) / 2;
      if (Math.min(p[2], q[2]) > NEAR) strokes.push({ p, q, depth, width: radius * (p[3] + q[3]), colour, cap });
    };
    for (const s of frame.solids) {
      // in short pieces the order by depth is right; those of see-through things would show their overlaps
      const parts = s.mesh === "capsule" && s.size > 0 && s.alpha === 1 ? 12 : 1;
      for (let k = 0; k < parts; k++) {
        const at = (t) => along(s.start, s.axis, s.size * t);
        stroke(at(k / parts), at((k + 1) / parts), s.radius, css(s.colour, s.alpha), s.mesh === "capsule" ? "round" : "butt");
      }
    }
    const { position, radius, contact } = frame.rod;
    for (let i = 0; i < episode.elements; i++) {
      const place = (i + 0.5) / episode.elements;
      const section = armColour(place, episode.agents);
      const colour = mixed(section, PAINT.touch, 0.7 * Math.max(contact[i], contact[i + 1]));
      stroke(vec(position, 3 * i), vec(position, 3 * i + 3), radius[i], css(colour));
    }
    for (const s of [...frame.path, ...frame.edges]) {
      const [p, q] = [view.project(s.a), view.project(s.b)];
      strokes.push({ p, q, depth: (p[2] + q[2]) / 2 - 0.03, width: s.width, colour: css(s.to, s.to[3]), cap: "round" });
    }
    strokes.sort((a, b) => b.depth - a.depth);
    for (const { p, q, width, colour, cap } of strokes) {
      context.lineCap = cap;
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.beginPath();
      context.moveTo(p[0], p[1]);
      context.lineTo(q[0] + 0.01, q[1]);
      context.stroke();
    }
  }
}
