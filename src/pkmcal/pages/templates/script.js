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
