/** Grid of images with their overlays; each opens in the inspector. */

import "./images.css";
import type { Image, Images } from "../document";
import { h } from "../dom";
import { legClass } from "../marks";
import { hrefOf, imageSvg } from "../overlay";
import { startTones } from "../tones";
import type { Context } from "./index";

export function images(block: Images, { selection, viewer }: Context): HTMLElement {
  // of images by hand each is a group of its own
  const groups = [...new Set(block.images.map((image) => image.group))].filter(Boolean).sort();
  const filters = groups.length > 1 && groups.length < block.images.length ? ["", ...groups] : [];
  const grid = h("div", { class: `images ${block.size}` });
  const bar = h("div", { class: "images-bar" });
  const element = h("div", {}, bar, grid);
  let group = "";
  let all = block.images.length <= block.first;

  const inGroup = (): Image[] => block.images.filter((image) => !group || image.group === group);
  const open = (image: Image): void => {
    viewer.open(inGroup().includes(image) ? inGroup() : block.images, image);
  };
  const figure = (image: Image): HTMLElement => {
    const picture = imageSvg(image);
    const background = picture.querySelector("image");
    if (background) void startTones(background, hrefOf(image));
    picture.setAttribute("aria-hidden", "true"); // the button has the name, with the texts in the image
    const texts = block.size === "figure" ? [...picture.querySelectorAll("text")].map((text) => text.textContent) : [];
    const button = h("button", {
      type: "button", class: "enlarge", title: "Inspect", "aria-label": ["Inspect", image.title, ...texts].join(" "),
    }, picture);
    button.addEventListener("click", (event) => {
      // an arrow leads to the image that it belongs to
      const key = (event.target as Element).closest<SVGElement>(".shape")?.dataset.key ?? "";
      if (key.startsWith("image:")) viewer.openKey(key);
      else open(image);
    });
    return h("figure", image.key ? { "data-key": image.key } : {}, button,
      h("figcaption", {}, h("b", {}, image.title), " ", h("span", { class: "small" }, image.caption)));
  };
  const draw = (): void => {
    const some = inGroup();
    grid.replaceChildren(...(all ? some : some.slice(0, block.first)).map(figure));
    selection.apply(grid);
    bar.replaceChildren(...legend(block.legs));
    bar.append(...filters.map((name) =>
      h("button", {
        type: "button", "aria-pressed": String(name === group), onclick: () => {
          group = name;
          draw();
        },
      }, name || "All")));
    if (some.length > block.first) {
      bar.append(h("button", {
        type: "button", "aria-pressed": String(all), onclick: () => {
          all = !all;
          draw();
        },
      }, all ? `First ${block.first}` : `All ${some.length} images`));
    }
    bar.hidden = !bar.childElementCount;
  };
  draw();
  viewer.add({ element, images: block.images, open });
  return element;
}

const legend = (legs: number): HTMLElement[] => legs ? [
  h("span", { class: "images-legs", role: "img", "aria-label": "Colours of the legs" },
    ...Array.from({ length: legs }, (_, j) =>
      h("span", { class: `chip on-image ${legClass(j + 1)}` }, String(j + 1)))),
] : [];
