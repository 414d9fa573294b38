/** Colours of the canvas: those of the style sheet, again when the scheme changes or the page is printed. */

import { Color, type Material } from "three";

type Painted = Material & { color: Color };

export class Palette {
  private readonly painted: { material: Painted; name: string }[] = [];
  private readonly media = ["(prefers-color-scheme: dark)", "print"].map((query) => matchMedia(query));

  constructor(onchange: () => void) {
    for (const one of this.media) {
      one.addEventListener("change", () => {
        for (const { material, name } of this.painted) material.color.copy(this.colour(name));
        onchange();
      });
    }
  }

  /** Colour of a custom property of the style sheet, such as `--leg1`. */
  colour(name: string): Color {
    return new Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  }

  /** The material, in a colour that follows the scheme. */
  paint<M extends Painted>(material: M, name: string): M {
    material.color.copy(this.colour(name));
    this.painted.push({ material, name });
    return material;
  }
}
