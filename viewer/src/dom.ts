/** Elements of the page, and numbers as text. */

type Attributes = Record<string, string | number | boolean | ((event: Event) => void)>;
type Child = Node | string;

/** Element with attributes, listeners (`onclick`, …) and children. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false) element.setAttribute(name, String(value));
  }
  element.append(...children);
  return element;
}

const N_COLOURS = 8;

/** Class of the colour of a leg's key, such as `leg:3`; empty for another key. */
export function legClass(key: string): string {
  return key.startsWith("leg:") ? `leg-${((Number(key.slice(4)) - 1) % N_COLOURS) + 1}` : "";
}

/** Factor and name of the unit in which a quantity is shown. */
export const UNITS = {
  m: { factor: 1e3, name: "mm", decimals: 1 },
  rad: { factor: 180 / Math.PI, name: "°", decimals: 2 },
} as const;
export type Unit = keyof typeof UNITS;

/** Number with a true minus sign and without negative zeros. */
export function number(value: number, decimals: number): string {
  const text = value.toFixed(decimals);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

/** Quantity in its unit, such as `415.0 mm` or `12.30°`. */
export function quantity(value: number, unit: Unit): string {
  const { factor, name, decimals } = UNITS[unit];
  return number(value * factor, decimals) + (name === "°" ? "" : " ") + name;
}
