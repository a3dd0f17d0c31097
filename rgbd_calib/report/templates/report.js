"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const narrow = window.matchMedia("(max-width: 600px)").matches;
const finger = window.matchMedia("(pointer: coarse)").matches;
const common = {
  font: { family: "system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif", size: 13, color: "#1d2329" },
  paper_bgcolor: "white",
  plot_bgcolor: "white",
  autosize: true,
  hovermode: "closest",
};
const options = { responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: false };
const view = document.getElementById("fig_scene");

function draw(id) {
  const { data, layout } = figures[id];
  const mine = Object.assign({}, common, layout);
  if (id === "fig_scene") {
    if (narrow) {
      mine.height = 460;
      const eye = mine.scene.camera.eye;
      mine.scene.camera.eye = { x: 1.3 * eye.x, y: 1.3 * eye.y, z: 1.3 * eye.z };
      for (const trace of data) {
        if (trace.marker && trace.marker.colorbar) {
          Object.assign(trace.marker.colorbar, { orientation: "h", x: 0.5, y: 1.0, yanchor: "bottom", len: 0.9 });
          trace.marker.colorbar.title.side = "top";
        }
      }
    }
    if (finger) mine.scene.dragmode = false;
    return Plotly.newPlot(id, data, mine, Object.assign({}, options, { scrollZoom: !finger }));
  }
  if (finger) mine.dragmode = false;
  if (narrow && mine.xaxis && mine.xaxis.type === "category") mine.xaxis.nticks = 5;
  return Plotly.newPlot(id, data, mine, options);
}

// one after the other, so that the page can be read meanwhile
async function drawAll() {
  for (const id of Object.keys(figures)) {
    if (document.getElementById(id)) {
      await draw(id);
      await new Promise((next) => setTimeout(next));
    }
  }
  document.body.dataset.drawn = "yes";
}
drawAll();

// plots inside folded parts were drawn without a width
for (const part of document.querySelectorAll("details")) {
  part.addEventListener("toggle", () => {
    if (part.open) part.querySelectorAll(".js-plotly-plot").forEach((plot) => Plotly.Plots.resize(plot));
  });
}

// before and after: every trace that moved says in `meta` where it was
const slide = document.getElementById("slide");
if (slide) {
  const traces = figures.fig_scene.data;
  const moved = traces.map((trace, i) => i).filter((i) => traces[i].meta && traces[i].meta.before);
  const after = moved.map((i) => ({ x: traces[i].x, y: traces[i].y, z: traces[i].z }));
  const between = (a, b, s) => a.map((v, k) => (v === null || b[k] === null ? null : (1 - s) * v + s * b[k]));
  slide.addEventListener("input", () => {
    const s = slide.valueAsNumber / 100;
    const at = (axis) => moved.map((i, k) => between(traces[i].meta.before[axis], after[k][axis], s));
    Plotly.restyle(view, { x: at("x"), y: at("y"), z: at("z") }, moved);
  });
}

// the wheel scrolls the page until the view is clicked, so that nobody gets stuck in it
let held = false;
view.addEventListener("mousedown", () => { held = true; }, true);
view.addEventListener("mouseleave", () => { held = false; });
view.addEventListener("wheel", (event) => { if (!held) event.stopPropagation(); }, { capture: true, passive: true });

// arrow keys turn the view about what is up in it, + and - come nearer and go farther
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (a) => a.map((v) => v / Math.sqrt(dot(a, a)));
function turned(p, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), q = cross(axis, p), along = dot(axis, p) * (1 - c);
  return p.map((v, k) => c * v + s * q[k] + along * axis[k]);
}
view.tabIndex = 0;
view.addEventListener("keydown", (event) => {
  const { eye, up } = view.layout.scene.camera;
  const from = [eye.x, eye.y, eye.z], axis = unit([up.x, up.y, up.z]);
  const step = Math.PI / 18, side = unit(cross(axis, from));
  const moves = {
    ArrowLeft: () => turned(from, axis, -step),
    ArrowRight: () => turned(from, axis, step),
    ArrowUp: () => turned(from, side, -step),
    ArrowDown: () => turned(from, side, step),
    "+": () => from.map((v) => v / 1.15),
    "-": () => from.map((v) => v * 1.15),
  };
  if (!moves[event.key]) return;
  event.preventDefault();
  const [x, y, z] = moves[event.key]();
  if (Math.abs(dot(unit([x, y, z]), axis)) < 0.98) Plotly.relayout(view, { "scene.camera.eye": { x, y, z } });
});

const touch = document.querySelector("button.touch");
touch.addEventListener("click", () => {
  const on = touch.getAttribute("aria-pressed") !== "true";
  touch.setAttribute("aria-pressed", String(on));
  touch.textContent = on ? "Scroll the page again" : "Turn the view with a finger";
  Plotly.relayout("fig_scene", { "scene.dragmode": on ? "orbit" : false });
});

// on paper: everything unfolded, plots as wide as the sheet
const PAPER_PX = 680;
let folded = [];
window.addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  folded.forEach((part) => { part.open = true; });
  document.querySelectorAll(".js-plotly-plot").forEach((plot) => {
    const grid = plot.closest(".grid, .pair");
    const width = grid ? (grid.classList.contains("small") ? PAPER_PX / 3 : PAPER_PX / 2) - 12 : PAPER_PX;
    if (plot.clientWidth > width || !plot.clientWidth) Plotly.relayout(plot, { width });
  });
});
window.addEventListener("afterprint", () => {
  folded.forEach((part) => { part.open = false; });
  document.querySelectorAll(".js-plotly-plot").forEach((plot) => Plotly.relayout(plot, { width: null, autosize: true }));
});
