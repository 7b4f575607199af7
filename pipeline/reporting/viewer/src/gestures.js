// Mouse, fingers, wheel and keys. The page scrolls over the scene until it is activated by a click
// or a tap; then all gestures belong to the scene until it is released.

const CLICK_PX = 6; // a click moves the pointer by at most this
const DOUBLE_MS = 350;
const TURN = Math.PI; // radians for a drag across the canvas' height

export class Gestures {
  // `act` has rotate, zoom, pan, ended, click, enter (the key), focus, step, reset, changed (active
  // or not) and ignored (a wheel that scrolled the page).
  constructor(box, canvas, act) {
    Object.assign(this, { box, canvas, act, active: false, pointers: new Map(), last: null });
    canvas.addEventListener("pointerdown", event => this.#down(event));
    canvas.addEventListener("pointermove", event => this.#move(event));
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, event => this.#up(event));
    canvas.addEventListener("wheel", event => this.#wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("keydown", event => this.#key(event));
    box.addEventListener("keydown", event => {
      if (event.key === "Escape") this.activate(false);
    });
    document.addEventListener("pointerdown", event => {
      if (!box.contains(event.target)) this.activate(false);
    });
    new IntersectionObserver(([{ isIntersecting }]) => {
      if (!isIntersecting) this.activate(false);
    }).observe(box);
  }

  activate(active) {
    if (this.active === active) return;
    this.active = active;
    this.canvas.style.touchAction = active ? "none" : "auto";
    this.act.changed(active);
  }

  // Fingers navigate only when active; a mouse's drag does not scroll, so it always does.
  #down(event) {
    this.pressed = { x: event.clientX, y: event.clientY, moved: this.pointers.size > 0 };
    if (event.pointerType === "touch" && !this.active) return;
    this.pointers.set(event.pointerId, event);
    this.canvas.setPointerCapture(event.pointerId);
  }

  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    if (Math.hypot(event.clientX - this.pressed.x, event.clientY - this.pressed.y) > CLICK_PX)
      this.pressed.moved = true;
    const height = this.canvas.clientHeight;
    const x = (event.clientX - before.clientX) / height;
    const y = (event.clientY - before.clientY) / height;
    this.pointers.set(event.pointerId, event);
    if (this.pointers.size === 2) {
      const other = [...this.pointers.values()].find(p => p.pointerId !== event.pointerId);
      const gap = p => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY) || 1;
      this.act.pan(x / 2, y / 2);
      this.act.zoom(gap(before) / gap(event));
    } else if (event.buttons & 2 || event.shiftKey) this.act.pan(x, y);
    else this.act.rotate(-TURN * x, TURN * y);
  }

  #up(event) {
    this.pointers.delete(event.pointerId);
    const { x, y, moved } = this.pressed ?? { moved: true };
    if (this.pointers.size) return;
    const near = Math.hypot(event.clientX - x, event.clientY - y) <= CLICK_PX;
    if (event.type === "pointerup" && !moved && near && event.button === 0) this.#click(event);
    else if (moved) this.act.ended();
  }

  #click(event) {
    const { last, active } = this;
    const again = last && event.timeStamp - last.timeStamp < DOUBLE_MS
      && Math.hypot(event.clientX - last.clientX, event.clientY - last.clientY) < 4 * CLICK_PX;
    this.last = again ? null : event;
    if (event.pointerType !== "touch" || !active) this.canvas.focus({ preventScroll: true });
    this.activate(true);
    const { left, top } = this.canvas.getBoundingClientRect();
    const at = [event.clientX - left, event.clientY - top];
    if (again) this.act.focus(...at);
    else if (event.pointerType !== "touch" || active) this.act.click(...at);
  }

  #wheel(event) {
    if (!this.active && !event.ctrlKey) return this.act.ignored();
    event.preventDefault();
    const pixels = event.deltaY * [1, 30, 300][event.deltaMode];
    this.act.zoom(Math.exp(Math.max(-200, Math.min(200, pixels)) * (event.ctrlKey ? 6e-3 : 1.2e-3)));
    clearTimeout(this.wheeled);
    this.wheeled = setTimeout(() => this.act.ended(), 200);
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1],
      ArrowDown: [0, -0.1] };
    const keys = {
      ArrowLeft: () => this.act.step(-1), ArrowRight: () => this.act.step(1),
      ArrowUp: () => this.act.zoom(1 / 1.1), ArrowDown: () => this.act.zoom(1.1),
      "+": () => this.act.zoom(1 / 1.1), "=": () => this.act.zoom(1 / 1.1),
      "-": () => this.act.zoom(1.1), Home: () => this.act.reset(), 0: () => this.act.reset(),
      Enter: () => this.act.enter(),
    };
    if (event.shiftKey && turns[event.key]) this.act.rotate(...turns[event.key]);
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault();
  }
}
