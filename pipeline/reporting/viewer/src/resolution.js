// The resolution of frames: lower where a device is too slow for the canvas's, as without a GPU.

const MOVING_MS = 80, STILL_MS = 1000; // the time that a frame may take while the view moves, and after
const FIRST_PIXELS = 5e4; // of the first frame, whose time is unknown
const LEAST = 1 / 4; // of the canvas's resolution, along each axis

export class Resolution {
  constructor(context) {
    this.context = context;
    this.cost = null; // the time of the last frame per pixel, ms
    this.warm = false; // whether a frame with Gaussians was drawn, for which shaders are compiled
  }

  // The share of the canvas's resolution along each axis that a frame can have, of which all has
  // this number of pixels.
  share(pixels, moving) {
    const affordable = this.cost === null ? FIRST_PIXELS : (moving ? MOVING_MS : STILL_MS) / this.cost;
    return Math.min(Math.max(Math.sqrt(affordable / pixels), LEAST), 1);
  }

  // Wait until the frame that was submitted last is drawn, which has this number of pixels. Frames
  // with Gaussians are measured.
  async drawn(pixels, hasGaussians) {
    const { context } = this, start = performance.now();
    const fence = context.fenceSync(context.SYNC_GPU_COMMANDS_COMPLETE, 0);
    if (!fence) return; // the context is lost
    context.flush();
    while (context.getSyncParameter(fence, context.SYNC_STATUS) === context.UNSIGNALED)
      await new Promise(done => setTimeout(done, 4));
    context.deleteSync(fence);
    if (hasGaussians && this.warm) this.cost = (performance.now() - start) / pixels;
    this.warm ||= hasGaussians;
  }
}
