"use strict";

// Tooltips: one box that follows the pointer, for everything with data-tip.
(() => {
  const tip = document.getElementById("tip");
  const hide = () => { tip.hidden = true; };
  const show = (event) => {
    const target = event.target.closest("[data-tip]");
    if (!target) return hide();
    const home = target.closest("dialog") || document.body;
    if (tip.parentNode !== home) home.append(tip); // a dialog lies above everything else
    tip.textContent = target.dataset.tip;
    tip.hidden = false;
    const box = tip.getBoundingClientRect();
    const left = Math.max(6, Math.min(event.clientX + 14, innerWidth - box.width - 6));
    const below = event.clientY + 18;
    const top = below + box.height > innerHeight ? event.clientY - box.height - 12 : below;
    tip.style.transform = `translate(${left}px, ${top}px)`;
  };
  addEventListener("pointerover", show);
  addEventListener("pointermove", show);
  addEventListener("scroll", hide, { passive: true });
})();

// Enlarged photographs; a click inside comes nearer still.
(() => {
  const dialog = document.getElementById("large");
  const frame = dialog.querySelector(".large-picture");
  for (const button of document.querySelectorAll(".enlarge")) {
    button.addEventListener("click", () => {
      const picture = button.querySelector("svg").cloneNode(true);
      const { width, height } = picture.viewBox.baseVal;
      frame.style.setProperty("--ratio", width / height);
      frame.classList.remove("near");
      frame.replaceChildren(picture);
      dialog.querySelector(".large-caption").textContent =
        button.parentNode.querySelector("figcaption").innerText.replace("\n", " · ");
      dialog.showModal();
    });
  }
  frame.addEventListener("click", (event) => {
    const box = frame.getBoundingClientRect();
    const x = (event.clientX - box.left + frame.scrollLeft) / frame.scrollWidth;
    const y = (event.clientY - box.top + frame.scrollTop) / frame.scrollHeight;
    frame.classList.toggle("near");
    frame.scrollTo(x * frame.scrollWidth - box.width / 2, y * frame.scrollHeight - box.height / 2);
  });
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
})();

// The table sorts by a column; a third click gives the order of the file back.
(() => {
  const table = document.getElementById("parameter-table");
  const bodies = [...table.tBodies];
  const rows = bodies.map((body) => [...body.rows]);
  const key = (row, by) => {
    if (by === "name") return row.dataset.name;
    if (by === "leg") return Number(row.dataset.leg);
    if (by === "share") return Number(row.dataset.share);
    return Math.abs(Number(row.dataset.values.split(" ")[Number(by)]));
  };
  const restore = () => {
    table.append(...bodies);
    bodies.forEach((body, i) => body.append(...rows[i]));
  };
  for (const head of table.querySelectorAll("th[data-sort]")) {
    head.querySelector("button").addEventListener("click", () => {
      const next = { none: "descending", descending: "ascending", ascending: "none" };
      const order = next[head.getAttribute("aria-sort") || "none"];
      for (const other of table.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
      restore();
      if (order === "none") return;
      head.setAttribute("aria-sort", order);
      const sign = order === "ascending" ? 1 : -1;
      const compare = (a, b) => {
        const [p, q] = [key(a, head.dataset.sort), key(b, head.dataset.sort)];
        return sign * (typeof p === "string" ? p.localeCompare(q) : p - q);
      };
      bodies[0].append(...rows.flat().sort(compare));
    });
  }
})();

// The view in space: Plotly, unpacked from the page itself.
(() => {
  const plot = document.getElementById("plot");
  const figure = JSON.parse(document.getElementById("figure").textContent);
  const style = getComputedStyle(document.documentElement);
  const themed = (node) => {
    if (typeof node === "string" && node.startsWith("--")) return style.getPropertyValue(node).trim();
    if (Array.isArray(node)) return node.map(themed);
    if (node === null || typeof node !== "object") return node;
    return Object.fromEntries(Object.entries(node).map(([name, value]) => [name, themed(value)]));
  };
  const options = { displayModeBar: false, responsive: true, scrollZoom: true };
  const draw = () => Plotly.react(plot, themed(figure.data), themed(figure.layout), options);
  const load = async () => {
    const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
    plot.replaceChildren();
    await draw();
    plot.dataset.drawn = "yes";
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  };
  const failed = () => {
    plot.textContent = "This browser cannot draw in space; the plane views show the same.";
    plot.classList.add("small");
  };
  load().catch(failed);
})();
