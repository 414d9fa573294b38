const key = (name, more = {}) => {
  $(".inspector").dispatchEvent(new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true, ...more }));
};
const press = (text) => all("button").find((one) => one.textContent === text && !one.closest("[hidden]")).click();
const joint = (end, leg) => {
  const ring = all(".joints .shape").find((one) => one.dataset.tip === `Leg ${leg}, ${end} joint`);
  return ring.querySelector(".mark").dataset.place.match(/-?[\d.]+/g).slice(0, 2).map(Number);
};
const screen = ([x, y]) => {
  const point = new DOMPoint(x, y).matrixTransform($(".inspected svg").getScreenCTM());
  return { clientX: point.x, clientY: point.y };
};
const pointer = (type, at, more = {}) => $(".inspected").dispatchEvent(new PointerEvent(type, {
  bubbles: true, cancelable: true, button: 0, pointerId: 1, ...screen(at), ...more }));
async function drag(from, to, atHalf = () => undefined, more = {}) {
  pointer("pointerdown", from, more);
  for (let k = 1; k <= 8; k += 1) {
    pointer("pointermove", from.map((v, i) => v + (to[i] - v) * k / 8), more);
    if (k === 4) { await settled(); atHalf(); }
  }
  pointer("pointerup", to, more);
  await settled();
}
const under = (place) => {
  $(".inspected").dispatchEvent(new PointerEvent("pointermove", { ...place, bubbles: true, pointerId: 5 }));
  return $(".inspector-where").textContent;
};
const marks = () => all(".session-images li .sign").map((one) => one.className.replace("sign ", ""));
addEventListener("load", async () => {
  await settled();
  out.first = $("[aria-label='Machine laid over'] [aria-pressed=true]").textContent;
  press("Nominal");
  await settled();
  const title = () => $(".session-image h2").textContent;
  out.size = await new Promise((done) => {
    const full = new Image();
    full.onload = () => done(`${full.naturalWidth}x${full.naturalHeight}`);
    full.src = $(".inspected image").getAttribute("href");
  });
  const list = all(".session-images img");
  list.forEach((one) => one.scrollIntoView());
  await settled();
  out.thumbnails = list.filter((one) => one.naturalWidth > 50).length;
  out.marks = JSON.stringify(marks());
  out.fit = $(".session-fit").className;
  key("ArrowRight");
  await settled();
  out.next = title();
  key("ArrowLeft"); key("ArrowDown"); key("ArrowUp");
  await settled();
  out.back = title();

  // the wheel zooms about the pointer, and moves nothing else
  const box = $(".inspected").getBoundingClientRect();
  const place = { // a wheel's event has whole pixels
    clientX: Math.round(box.left + 0.3 * box.width), clientY: Math.round(box.top + 0.6 * box.height),
  };
  const before = joint("platform", 2);
  for (let k = 0; k < 3; k += 1) key("+"); // so that the image fills the window
  const whole = under(place);
  for (let k = 0; k < 4; k += 1) $(".inspected").dispatchEvent(new WheelEvent("wheel", { ...place, deltaY: -300, cancelable: true, bubbles: true }));
  out.zoomed = JSON.stringify([whole, under(place)]);
  out.unmoved = JSON.stringify([before, joint("platform", 2)]);
  key("0");

  // a drag of a joint, by mouse; what was measured before is gone meanwhile
  const to = before.map((v) => v + 25);
  out.measured = all(".edges .shape").length;
  await drag(before, to, () => { out.ghosts = all(".edges .shape, .rejected .shape").length; out.during = $(".session-fit").className; });
  out.pulled = JSON.stringify([to, joint("platform", 2)]);
  out.filled = all(".joints .filled").length;
  out.changed = !all("button").find((one) => one.textContent.startsWith("Write")).disabled;
  key("z", { ctrlKey: true });
  await settled();
  out.undone = JSON.stringify([before, joint("platform", 2)]);
  // a second finger ends a drag, and both zoom
  pointer("pointerdown", before, { pointerType: "touch" });
  pointer("pointermove", to, { pointerType: "touch" });
  pointer("pointerdown", [40, 40], { pointerType: "touch", pointerId: 2 });
  await settled();
  pointer("pointermove", [30, 30], { pointerType: "touch", pointerId: 2 });
  pointer("pointerup", to, { pointerType: "touch" }); pointer("pointerup", [30, 30], { pointerType: "touch", pointerId: 2 });
  await settled();
  out.pinched = JSON.stringify([before, joint("platform", 2)]);
  key("0");
  press("Pan");
  await drag([100, 100], [160, 140]);
  out.panned = JSON.stringify([before, joint("platform", 2)]);
  press("Farther");
  await wait(400);
  await settled();
  out.farther = JSON.stringify([before, joint("platform", 2)]);
  key("z", { ctrlKey: true });
  await settled();

  // a number at a leg, in place of another one, is removed by a second click
  press("Number legs");
  const click = (leg) => { press(leg); pointer("pointerdown", before); pointer("pointerup", before); };
  const numbers = () => all(".joints .shape").map((one) => one.dataset.tip).filter((tip) => tip.startsWith("You"));
  click("3"); click("2");
  out.numbered = JSON.stringify(numbers());
  out.number_moves = !all("button").find((one) => one.textContent.startsWith("Write")).disabled;
  click("2");
  out.unnumbered = numbers().length;
  // a number that no place agrees with: other places are offered, and Undo returns from them
  pointer("pointerdown", [2, 2]); pointer("pointerup", [2, 2]);
  press("Fit");
  await settled();
  out.refused = $(".session-status").className;
  out.offered = all(".session-places:not([hidden]) button").length;
  key("z", { ctrlKey: true });
  await settled();
  press("Move");

  // two joints at their places: the machine is localized, and the pose saved
  for (const [end, leg, pixel] of PLACES) await drag(joint(end, leg), pixel);
  out.status = $(".session-status").className;
  out.fitted = $(".session-fit").className;
  out.remarks = JSON.stringify(marks());
  press("Write into session.yaml");
  await settled();
  out.saved = $(".session-status").className;
  press("Calibrated");
  await settled();
  out.calibrated = $(".session-fit").className;
  press("In space");
  await settled();
  await wait(500);
  out.stage = $(".session-stage canvas")?.width > 100;
  key("ArrowRight");
  await settled();
  press("Image");
  await settled();
  const image = $(".inspected image"), window_ = $(".inspected").getBoundingClientRect();
  out.window = JSON.stringify([window_.width, window_.height]);
  out.whole = Math.min(window_.width / image.width.baseVal.value, window_.height / image.height.baseVal.value);
  out.scale = $(".inspector-where").textContent.replace("×", "");
  finish();
});
