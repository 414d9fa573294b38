/** Buttons, and groups of them of which one is pressed. */

import { h } from "../dom";

export function button(text: string, act: () => void, title = ""): HTMLButtonElement {
  return h("button", { type: "button", onclick: act, ...(title ? { title } : {}) }, text);
}

/** Group of buttons of which one is pressed. */
export function choice<T extends string>(
  label: string, items: [T, string, string?][], first: T, onchoose: (name: T) => void,
): HTMLElement {
  const group = h("span", { class: "choice", role: "group", "aria-label": label });
  group.append(...items.map(([name, text, title]) => {
    const one = button(text, () => {
      press(group, name);
      onchoose(name);
    }, title);
    one.dataset.name = name;
    return one;
  }));
  press(group, first);
  return group;
}

/** Mark the button of a name as pressed, and no other. */
export function press(group: HTMLElement, name: string): void {
  for (const one of group.querySelectorAll("button")) one.setAttribute("aria-pressed", String(one.dataset.name === name));
}
