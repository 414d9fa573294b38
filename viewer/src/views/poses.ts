/** Configurations for changed readings: from the page's own sweeps, or from the program. */

import type { Configuration, Sweep } from "../document";

type Answer = { configuration: Configuration | null } | { message: string };
/** Reading k moves to a value, from the configuration that is shown; of the requests that wait, the
 * last one is answered. */
export type Poses = (
  k: number,
  value: number,
  from: () => Configuration,
  answer: (answer: Answer) => void,
) => void;

/** The nearest configuration of the reading's sweep. */
export function sweptPoses(sweeps: Sweep[]): Poses {
  return (k, value, _from, answer) => {
    const { values, configurations } = sweeps[k];
    const gaps = values.map((one) => Math.abs(one - value));
    answer({ configuration: configurations[gaps.indexOf(Math.min(...gaps))] });
  };
}

/** Requests to the program that serves the page: one at a time, of those that wait the latest. */
export function askProgram(): Poses {
  let busy = false;
  let waiting: (() => void) | null = null;
  const ask: Poses = (k, value, from, answer) => {
    if (busy) {
      waiting = () => ask(k, value, from, answer);
      return;
    }
    busy = true;
    const start = from();
    void request(k, value, start).then((result) => {
      busy = false;
      // an answer from a configuration that is no longer shown, as after Home, is not either
      if (from() === start) answer(result);
      const next = waiting;
      waiting = null;
      next?.();
    });
  };
  return ask;
}

async function request(index: number, value: number, from: Configuration): Promise<Answer> {
  const { readings, T_base_platform } = from;
  try {
    const response = await fetch("pose", {
      method: "POST",
      body: JSON.stringify({ index, value, readings, T_base_platform }),
    });
    return (await response.json()) as Answer;
  } catch {
    return { message: "pkmcal no longer answers: was it interrupted?" };
  }
}
