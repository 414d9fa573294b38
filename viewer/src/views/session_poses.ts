/** Pose of a station as its page has it, with the steps that can be undone. */

import type { Pin, ViewRequest } from "../document";

export type Pose = NonNullable<ViewRequest["pose"]>;
interface Step {
  pose: Pose | null;
  pins: Pin[];
  unpinned: Pose | null;
  numbers: Pin[];
  changed: boolean;
}

export class StationPose {
  /** T_camera_base; null for the files' own. */
  pose: Pose | null = null;
  /** Joints placed at pixels. */
  pins: Pin[] = [];
  /** The pose before them; null for the files' own. */
  unpinned: Pose | null = null;
  /** Legs numbered at pixels: they hold wherever the machine is. */
  numbers: Pin[] = [];
  /** Whether session.yaml has another pose. */
  changed = false;
  private readonly before: Step[] = [];

  constructor(public posed: boolean) {}

  get undoable(): boolean {
    return this.before.length > 0;
  }

  /** Begin a change. */
  begin(): void {
    const { pose, pins, unpinned, numbers, changed } = this;
    this.before.push({ pose, pins, unpinned, numbers, changed });
    this.changed = true;
  }

  /** Number a leg at a pixel, in place of the numbers at which the pixel was aimed. */
  number(pin: Pin, replaced: (one: Pin) => boolean): void {
    const { changed } = this;
    this.begin();
    this.changed = changed; // the machine stands where it stood
    const others = this.numbers.filter((one) => !replaced(one));
    const again = others.length < this.numbers.length && this.numbers.some((one) => replaced(one) && one.leg === pin.leg);
    this.numbers = again ? others : [...others, pin];
  }

  /** Return to the state before the last change; false without one. */
  undo(): boolean {
    const last = this.before.pop();
    if (last) Object.assign(this, last);
    return last !== undefined;
  }

  /** A pose was written into session.yaml: the present one, if it did not change meanwhile. */
  saved(pose: Pose | null): void {
    for (const step of this.before) step.changed = true;
    this.changed = this.pose !== pose;
    this.posed = true;
  }
}
