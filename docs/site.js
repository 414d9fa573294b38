// The theme's foot and its bar of pages lie in no landmark; so that they are found, each is one.
document.querySelector('footer [role="contentinfo"]')?.removeAttribute("role");
document.querySelector("footer")?.setAttribute("role", "contentinfo");
for (const bar of document.querySelectorAll(".rst-versions")) {
  bar.setAttribute("role", "navigation");
  bar.setAttribute("aria-label", "Page before and after");
}
