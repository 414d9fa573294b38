// What can be scrolled sideways can be reached by the keyboard, as long as there is anything to scroll.
// The documentation's site takes this file as well, whose theme has areas of its own.
(() => {
  const site = ".rst-content pre code, .wy-table-responsive, .rst-content table";
  const areas = [...document.querySelectorAll(`.scroll, ${site}`)];
  const mark = () => {
    for (const area of areas) {
      if (area.scrollWidth > area.clientWidth) area.tabIndex = 0;
      else area.removeAttribute("tabindex");
    }
  };
  addEventListener("load", mark);
  addEventListener("resize", mark);
})();
