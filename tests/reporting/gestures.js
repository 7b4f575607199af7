// Gestures as events on the viewer's canvas, and the state of the view after each. They come faster
// than the browser draws.
{
  const canvas = document.querySelector("#space canvas");
  canvas.setPointerCapture = () => {}; // Not of pointers that only a script has.
  const area = canvas.getBoundingClientRect();
  const pointer = (type, x, y, more = {}) => canvas.dispatchEvent(new PointerEvent(type, {
    clientX: area.left + (x + 1) / 2 * area.width, clientY: area.top + (y + 1) / 2 * area.height,
    pointerId: 1, pointerType: "mouse", button: 0, buttons: 1, bubbles: true, ...more,
  }));
  const drag = (x, y, dx, dy, more) => {
    pointer("pointerdown", x, y, more);
    for (const t of [0.25, 0.5, 0.75, 1]) pointer("pointermove", x + t * dx, y + t * dy, more);
    pointer("pointerup", x + dx, y + dy, more);
  };
  const touch = id => ({ pointerId: id, pointerType: "touch" });
  const kinds = {
    drag: (x, y, dx, dy) => drag(x, y, 1.5 * dx, 1.5 * dy),
    pan: (x, y, dx, dy) => drag(x, y, dx, dy, { shiftKey: true }),
    tap: (x, y) => drag(x, y, 0, 0),
    double(x, y) {
      drag(x, y, 0, 0);
      drag(x, y, 0, 0);
    },
    wheel: (x, y, amount) => canvas.dispatchEvent(new WheelEvent("wheel", {
      deltaY: 600 * amount, bubbles: true, cancelable: true, ctrlKey: true,
    })),
    swipe(x, y, dx, dy, ex, ey) {
      kinds.tap(x, y);
      pointer("pointerdown", x, y, touch(2));
      pointer("pointerdown", -x, -y, touch(3));
      for (const t of [0.5, 1]) {
        pointer("pointermove", x + t * dx, y + t * dy, touch(2));
        pointer("pointermove", -x + t * ex, -y + t * ey, touch(3));
      }
      pointer("pointerup", x + dx, y + dy, touch(2));
      pointer("pointerup", -x + ex, -y + ey, touch(3));
    },
    key(x) {
      const keys = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "+", "-"];
      const key = keys[Math.floor((x + 1) / 2 * keys.length)];
      for (const shiftKey of [false, true])
        canvas.dispatchEvent(new KeyboardEvent("keydown", { key, shiftKey, bubbles: true }));
    },
  };
  window.play = gestures => gestures.map(({ kind, values }) => {
    kinds[kind](...values);
    return window.viewer.state();
  });
}
