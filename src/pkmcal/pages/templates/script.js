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

// Enlarged images; a click inside comes nearer still.
(() => {
  const dialog = document.getElementById("large");
  const frame = dialog.querySelector(".large-picture");
  for (const button of document.querySelectorAll(".enlarge")) {
    button.addEventListener("click", () => {
      const picture = button.querySelector("svg").cloneNode(true);
      const { width, height } = picture.viewBox.baseVal;
      const { large } = button.dataset;
      if (large) picture.querySelector("image").setAttribute("href", `data:image/jpeg;base64,${large}`);
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
