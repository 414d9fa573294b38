// Plots: Plotly, unpacked from the page itself. Each plot names the element that holds its figure.
(() => {
  const plots = [...document.querySelectorAll("[data-figure]")];
  const figures = plots.map((plot) => JSON.parse(document.getElementById(plot.dataset.figure).textContent));
  const style = getComputedStyle(document.documentElement);
  const themed = (node) => {
    if (typeof node === "string" && node.startsWith("--")) return style.getPropertyValue(node).trim();
    if (Array.isArray(node)) return node.map(themed);
    if (node === null || typeof node !== "object") return node;
    return Object.fromEntries(Object.entries(node).map(([name, value]) => [name, themed(value)]));
  };
  const options = { displayModeBar: false, responsive: true };
  const draw = () => Promise.all(plots.map((plot, i) => {
    const figure = themed(figures[i]);
    return Plotly.react(plot, figure.data, figure.layout, { ...options, ...figure.config });
  }));
  const load = async () => {
    const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
    for (const plot of plots) plot.replaceChildren();
    await draw();
    for (const plot of plots) plot.dataset.drawn = "yes";
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  };
  const failed = () => {
    for (const plot of plots) {
      plot.textContent = plot.dataset.otherwise;
      plot.classList.add("small");
    }
  };
  load().catch(failed);
})();
