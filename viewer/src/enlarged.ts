/**
 * Entry for pages that are not yet views of the viewer: their enlarged images in the inspector. A
 * picture is a `.enlarge` button with an SVG, the image at more pixels in `data-large`.
 */

import { h } from "./dom";
import { Inspector } from "./inspector";

function start(): void {
  const dialog = document.getElementById("large") as HTMLDialogElement | null;
  const buttons = [...document.querySelectorAll<HTMLButtonElement>(".enlarge")];
  if (!dialog || !buttons.length) return;
  let current = 0;
  const caption = h("p", { class: "large-caption" });
  const show = (k: number): void => {
    current = (k + buttons.length) % buttons.length;
    const button = buttons[current];
    const picture = button.querySelector("svg")?.cloneNode(true) as SVGSVGElement;
    const { large } = button.dataset;
    if (large) picture.querySelector("image")?.setAttribute("href", `data:image/jpeg;base64,${large}`);
    caption.textContent =
      button.parentElement?.querySelector("figcaption")?.innerText.replace("\n", " · ") ?? "";
    if (!dialog.open) dialog.showModal();
    inspector.show(picture);
  };
  const inspector = new Inspector((by) => show(current + by));
  dialog.append(
    caption,
    h("button", { type: "button", class: "close", "aria-label": "Close", onclick: () => dialog.close() }, "×"),
    inspector.element,
  );
  buttons.forEach((button, k) => button.addEventListener("click", () => show(k)));
  dialog.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const slides = event.target instanceof HTMLInputElement && event.key.startsWith("Arrow");
    if (!slides && inspector.key(event.key)) event.preventDefault();
  });
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close();
  });
}

start();
