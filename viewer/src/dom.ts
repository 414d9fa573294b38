/** Elements of the page, and numbers as text. */

type Attributes = Record<string, string | number | boolean | ((event: Event) => void)>;
type Child = Node | string;
const WITHIN_QUANTITY = /(?<=\d) (?=(?:±|%|σ|mm|px|µm|m|mrad|rad|s)(?![\p{L}\p{N}]))|(?<=±) (?=\d)/gu;

/** Children with their numbers and units on one line. */
const unbroken = (children: Child[]): Child[] =>
  children.map((one) => (typeof one === "string" ? one.replace(WITHIN_QUANTITY, "\u00a0") : one));

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
  element.append(...unbroken(children));
  return element;
}

/** SVG element with attributes and children. */
export function svg<K extends keyof SVGElementTagNameMap>(
  tag: K,
  attributes: Record<string, string | number> = {},
  ...children: Child[]
): SVGElementTagNameMap[K] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  element.append(...children);
  return element;
}

const CODE = /`([^`]+)`|(--[a-z][a-z-]*)/;

/** Sentences, with commands in backticks and options as code, which no line breaks. */
export function prose(text: string): Child[] {
  // a match gives two parts, of which one is absent
  return text.split(CODE).flatMap((part, k) =>
    part ? [k % 3 ? h("code", { class: k % 3 === 2 && "option" }, part) : part] : []);
}

/** Factor and name of the unit in which a quantity is shown. */
export const UNITS = {
  m: { factor: 1e3, name: "mm", decimals: 1 },
  rad: { factor: 180 / Math.PI, name: "°", decimals: 2 },
} as const;
type Unit = keyof typeof UNITS;

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
