// The animation's pictures, added once its plot stands.
(() => {
  const plot = document.getElementById("plot-space");
  const frames = JSON.parse(document.getElementById("frames").textContent);
  const add = () => {
    if (plot.dataset.drawn !== "yes") return false;
    Plotly.addFrames(plot, frames);
    return true;
  };
  const watch = new MutationObserver(() => add() && watch.disconnect());
  watch.observe(plot, { attributes: true, attributeFilter: ["data-drawn"] });
})();
