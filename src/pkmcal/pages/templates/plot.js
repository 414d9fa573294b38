// Plots: Plotly, unpacked from the page itself; figures and an animation's pictures by their names.
(() => {
  const plots = [...document.querySelectorAll("[data-plot]")];
  const read = (what, plot) => {
    const held = document.getElementById(`${what}-${plot.dataset.plot}`);
    return held && JSON.parse(held.textContent);
  };
  const figures = plots.map((plot) => read("figure", plot));
  const style = getComputedStyle(document.documentElement);
  const themed = (node) => {
    if (typeof node === "string" && node.startsWith("--")) return style.getPropertyValue(node).trim();
    if (Array.isArray(node)) return node.map(themed);
    if (node === null || typeof node !== "object") return node;
    return Object.fromEntries(Object.entries(node).map(([name, value]) => [name, themed(value)]));
  };
  // A figure in space that is told how it is seen in narrow pictures.
  const seen = ({ meta, ...layout }, width, height) => {
    if (meta?.narrow && width < meta.wide * height) {
      layout.scene = { ...layout.scene, camera: meta.narrow };
    }
    return layout;
  };
  const options = { displayModeBar: false, responsive: true };
  const draw = (size = () => ({})) => Promise.all(plots.map((plot, i) => {
    const figure = themed(figures[i]);
    const layout = seen({ ...figure.layout, ...size(plot) }, plot.clientWidth, plot.clientHeight);
    return Plotly.react(plot, figure.data, layout, { ...options, ...figure.config });
  }));
  // On paper: in light colours, as wide as a panel on A4 between its margins, and lower, as the style
  // has it there, so that two find room on a sheet.
  const sheet = (plot) => ({ width: 672, height: 0.78 * parseFloat(plot.style.getPropertyValue("--tall")) });
  const paper = async (printing) => {
    document.documentElement.classList.toggle("paper", printing);
    await draw(printing ? sheet : () => ({ autosize: true }));
    if (!printing) for (const plot of plots) Plotly.Plots.resize(plot);
  };
  // What WebGL draws does not reach paper: there a picture of it stands, in light colours, as wide as
  // the sheet. It is made once and beforehand, since printing waits for nobody.
  const pictured = async (plot, figure) => {
    const root = document.documentElement, screen = !root.classList.contains("paper");
    if (screen) root.classList.add("paper");
    const { data, layout } = themed(figure);
    if (screen) root.classList.remove("paper");
    // alone in its section as low as on a screen: cameras stand to the sides
    const size = { width: 672, height: plot.closest("#geometry") ? 440 : 320 };
    const margin = { ...layout.margin, b: 8 };  // without the slider
    const bare = { ...layout, ...size, margin, autosize: false, sliders: [], updatemenus: [] };
    const still = seen(bare, size.width, size.height);
    const image = new Image();
    image.src = await Plotly.toImage({ data, layout: still }, { format: "png", scale: 2, ...size });
    image.alt = plot.getAttribute("aria-label");
    image.className = "printed";
    plot.closest("figure").append(image);
  };
  const load = async () => {
    const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
    for (const plot of plots) plot.replaceChildren();
    await draw();
    for (const plot of plots) {
      const frames = read("frames", plot);
      if (frames) await Plotly.addFrames(plot, frames);
      // a point that stands for an image leads to it
      plot.on("plotly_click", ({ points }) => {
        const lead = points[0].customdata;
        if (typeof lead === "string" && lead.startsWith("#")) location.hash = lead;
      });
      plot.dataset.drawn = "yes";
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw());
    addEventListener("beforeprint", () => paper(true));
    addEventListener("afterprint", () => paper(false));
    for (const [i, plot] of plots.entries()) {
      if (figures[i].layout.scene) await pictured(plot, figures[i]).catch(() => {});
    }
  };
  const failed = () => {
    for (const plot of plots) {
      plot.textContent = "This browser cannot draw the plot; tables and charts have its figures.";
      plot.classList.add("small");
    }
  };
  load().catch(failed);
})();
