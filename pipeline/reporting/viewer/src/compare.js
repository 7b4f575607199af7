// The photograph over the render, up to a divider that one drags. The page's section of pictures
// has the photographs of some views.

// Lay `element` over the image of `camera` in a view of this focal length in pixels and size.
export function place({ style }, camera, focal, width, height) {
  const x = focal / camera.fx, y = focal / camera.fy;
  Object.assign(style, {
    left: `${width / 2 - camera.cx * x}px`, width: `${camera.width * x}px`,
    top: `${height / 2 - camera.cy * y}px`, height: `${camera.height * y}px`,
  });
}

export class Comparison {
  constructor(box) {
    this.frame = box.querySelector(".photograph");
    this.picture = this.frame.querySelector("img");
    this.slider = this.frame.querySelector("input");
    this.camera = null;
    this.asked = [null];
    // The viewer can start before the browser has the page's pictures.
    document.addEventListener("DOMContentLoaded", () => this.show(...this.asked));
    this.slider.addEventListener("input", () => this.#divide());
    this.#divide();
  }

  #divide() {
    this.frame.style.setProperty("--at", `${this.slider.value}%`);
  }

  static of(name) {
    return document.querySelector(`img[data-photograph="${CSS.escape(name)}"]`);
  }

  // Show the photograph of `camera`, if the page has it; the view is as for `place`.
  show(...asked) {
    this.asked = asked;
    const [camera, focal, width, height] = asked;
    const source = camera && Comparison.of(camera.name);
    this.camera = source ? camera : null;
    this.frame.hidden = !source;
    if (!source) return;
    if (this.picture.src !== source.src) this.picture.src = source.src;
    this.slider.setAttribute("aria-label", `photograph or render of ${camera.name}`);
    place(this.frame, camera, focal, width, height);
  }
}
