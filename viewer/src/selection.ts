/**
 * Selection that all blocks of a page share: the leg, station, configuration or image under the
 * pointer, and the chosen one. Elements carry their key as `data-key`; a canvas subscribes.
 */

export type Key = string;
type Listener = (hovered: Key | null, chosen: Key | null) => void;

export class Selection {
  private hovered: Key | null = null;
  private chosen: Key | null = null;
  private readonly listeners: Listener[] = [];

  /** Call a listener at each change; it compares with `matches`. */
  subscribe(listener: Listener): void {
    this.listeners.push(listener);
  }

  hover(key: Key | null): void {
    if (key === this.hovered) return;
    this.hovered = key;
    this.notify();
  }

  choose(key: Key | null): void {
    if (key === null && this.chosen === null) return;
    this.chosen = key === this.chosen ? null : key;
    this.notify();
  }

  /** Classes of the elements with a key below a root, also of new ones. */
  apply(root: ParentNode): void {
    for (const element of root.querySelectorAll<HTMLElement>("[data-key]")) {
      const key = element.dataset.key ?? "";
      element.classList.toggle("hovered", matches(key, this.hovered));
      element.classList.toggle("chosen", matches(key, this.chosen));
    }
  }

  private notify(): void {
    for (const listener of this.listeners) listener(this.hovered, this.chosen);
  }
}

/** Whether an element with a key belongs to the selected one: an image to its configuration, too. */
export function matches(key: Key, selected: Key | null): boolean {
  if (!key || !selected) return false;
  if (key === selected) return true;
  const [image, other] = key.startsWith("image:") ? [key, selected] : [selected, key];
  if (!image.startsWith("image:")) return false;
  const slash = image.indexOf("/");
  return other === `configuration:${image.slice(slash + 1)}` || other === `station:${image.slice(6, slash)}`;
}

/** Elements that are chosen by a click; canvases and images have more to do at theirs. */
const CHOSEN_BY_CLICK = "tr[data-key], .plot [data-key]";

/** Hovering and clicking elements with `data-key` inside a host, and their classes. */
export function connect(host: HTMLElement, selection: Selection): void {
  const keyOf = (event: Event): Key | null =>
    (event.target as Element).closest<HTMLElement>("[data-key]")?.dataset.key || null;
  host.addEventListener("pointerover", (event) => selection.hover(keyOf(event)));
  host.addEventListener("pointerleave", () => selection.hover(null));
  host.addEventListener("click", (event) => {
    const target = event.target as Element;
    const key = target.closest<HTMLElement>(CHOSEN_BY_CLICK)?.dataset.key;
    if (key && !target.closest("a, button")) selection.choose(key);
  });
  addEventListener("keydown", (event) => { if (event.key === "Escape") selection.choose(null); });
  host.addEventListener("keydown", (event) => {
    const row = event.target as HTMLElement;
    if (event.key === "Enter" && row.matches("tr[data-key]")) selection.choose(row.dataset.key ?? null);
  });
  selection.subscribe(() => selection.apply(host));
}
