// What can be scrolled sideways can be reached by the keyboard, as long as there is anything to scroll.
(() => {
  const areas = [...document.querySelectorAll(".scroll")];
  const mark = () => {
    for (const area of areas) {
      if (area.scrollWidth > area.clientWidth) area.tabIndex = 0;
      else area.removeAttribute("tabindex");
    }
  };
  addEventListener("load", mark);
  addEventListener("resize", mark);
})();
