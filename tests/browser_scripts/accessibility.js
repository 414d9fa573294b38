// The list of a folder, and then each of its entries.
addEventListener("load", async () => {
  await settled();
  for (const one of all("details")) one.open = true;
  await wait(1500);
  const { violations } = await axe.run(document, {
    runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"],
    resultTypes: ["violations"],
  });
  const pages = JSON.parse(sessionStorage.pages ?? "[]");
  pages.push({
    title: $("h1").textContent,
    faults: faults.join("; "),
    violations: violations.map((one) => [one.id, one.nodes.map((node) => node.html.slice(0, 200))]),
  });
  sessionStorage.pages = JSON.stringify(pages);
  const [next, ...others] = JSON.parse(sessionStorage.others ?? JSON.stringify(all("tbody a").map((one) => one.href)));
  sessionStorage.others = JSON.stringify(others);
  if (next) return location.assign(next);
  out.pages = sessionStorage.pages;
  finish();
});
