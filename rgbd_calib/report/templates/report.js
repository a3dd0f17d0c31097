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

function draw(id) {
  const { data, layout } = figures[id];
  const mine = Object.assign({}, common, layout);
  if (id === "fig_scene") {
    if (narrow) {
      mine.height = 420;
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
  return Plotly.newPlot(id, data, mine, options);
}

const drawn = Promise.all(Object.keys(figures).filter((id) => document.getElementById(id)).map(draw));
drawn.then(() => { document.body.dataset.drawn = "yes"; });

// the wheel scrolls the page until the view is clicked, so that nobody gets stuck in it
const view = document.getElementById("fig_scene");
let held = false;
view.addEventListener("mousedown", () => { held = true; }, true);
view.addEventListener("mouseleave", () => { held = false; });
view.addEventListener("wheel", (event) => { if (!held) event.stopPropagation(); }, { capture: true, passive: true });

const touch = document.querySelector("button.touch");
touch.addEventListener("click", () => {
  const on = touch.getAttribute("aria-pressed") !== "true";
  touch.setAttribute("aria-pressed", String(on));
  touch.textContent = on ? "Scroll the page again" : "Turn the view with a finger";
  Plotly.relayout("fig_scene", { "scene.dragmode": on ? "orbit" : false });
});
