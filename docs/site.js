// The theme's foot and its bar of pages lie in no landmark; so that they are found, each is one.
document.querySelector('footer [role="contentinfo"]')?.removeAttribute("role");
document.querySelector("footer")?.setAttribute("role", "contentinfo");
for (const bar of document.querySelectorAll(".rst-versions")) {
  bar.setAttribute("role", "navigation");
  bar.setAttribute("aria-label", "Page before and after");
}
// What can be scrolled sideways can be reached by the keyboard, as long as there is anything to scroll.
(() => {
  const areas = [...document.querySelectorAll("pre code, .wy-table-responsive, .rst-content table")];
  const mark = () => {
    for (const area of areas) {
      if (area.scrollWidth > area.clientWidth) area.tabIndex = 0;
      else area.removeAttribute("tabindex");
    }
  };
  addEventListener("load", mark);
  addEventListener("resize", mark);
})();
