// A table with data-sort sorts by a column; a third click gives the order of the file back.
for (const table of document.querySelectorAll("table.sorted")) {
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
}
