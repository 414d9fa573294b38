// What can be scrolled sideways is reached by the keyboard, as long as there is anything to scroll.
(() => {
  const mark = () => {
    for (const area of document.querySelectorAll(".equation, .md-typeset__scrollwrap, pre code")) {
      if (area.scrollWidth > area.clientWidth) area.tabIndex = 0;
      else area.removeAttribute("tabindex");
    }
  };
  addEventListener("load", mark);
  addEventListener("resize", mark);
})();
