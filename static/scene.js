// The 3-D scene in the centre: viser in a frame, asked for only after the first images are on the screen,
// because a frame of the same origin shares the page's thread.

import { byId, make } from "./dom.js";
import { FrameGate } from "./framegate.js";

const PATIENCE_MS = 1500;

/** Whether WebGL is drawn by the processor: then half the pixels halve the time of a frame. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return null;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export class Scene {
  #frame = null;
  #gate = null; // of a scene that is drawn by the processor
  #timer = 0;
  #wanted = null;
  #isMissing = false; // the browser draws no 3-D

  /** `send(message)` tells the server which layers are on. */
  constructor(state, send) {
    this.state = state;
    for (const button of document.querySelectorAll("[data-layer]"))
      button.addEventListener("click", () => {
        const layers = { ...state.layers, [button.dataset.layer]: !state.layers[button.dataset.layer] };
        state.set({ layers });
        send({ type: "layers", layers });
      });
    state.watch(["layers", "detail"], () => {
      for (const button of document.querySelectorAll("[data-layer]")) button.setAttribute("aria-pressed", String(state.layers[button.dataset.layer]));
      document.querySelector("[data-layer=truth]").hidden = !state.detail?.ground_truth;
    });
    byId("reset-view").addEventListener("click", () => this.reset());
    state.watch(["shown"], () => state.shown !== null && this.#load());
  }

  /** Images are under way, and a scene that shares the page's processor waits for them. */
  hold() {
    this.#gate?.hold();
  }

  /** They are on the screen, or will not come. */
  release() {
    this.#gate?.release();
  }

  /** The address of the tab's scene is known; it is loaded after the first images, or when they do not come. */
  prepare(address) {
    if (!address || this.#wanted === address) return;
    this.#wanted = address;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#load(), PATIENCE_MS);
  }

  #load() {
    if (!this.#wanted || this.#isMissing || this.#frame?.dataset.address === this.#wanted) return;
    clearTimeout(this.#timer);
    const software = isSoftware();
    if (software === null) return this.#without();
    const url = new URL(this.#wanted, location.href);
    url.searchParams.set("hideViserLogo", "");
    url.searchParams.set("darkMode", "");
    if (software) url.searchParams.set("fixedDpr", "0.5");
    this.#frame?.remove();
    this.#frame = make("iframe", { src: url.href, title: "3-D scene: map, trajectory, keyframes and camera", dataset: { address: this.#wanted } });
    // Its warnings about the browser and its panel stay away: what is of use stands in this page.
    this.#frame.addEventListener("load", () => {
      const style = make("link", { rel: "stylesheet", href: "/static/scene.css" });
      // Until then the frame would be a white field.
      style.addEventListener("load", () => this.#frame.classList.add("ready"));
      this.#frame.contentDocument.head.append(style);
    });
    if (software) this.#frame.addEventListener("load", () => (this.#gate = new FrameGate(this.#frame.contentWindow)));
    // The keys of the page work in the scene too, unless it wants them for a field of its own.
    this.#frame.addEventListener("load", () => {
      this.#frame.contentWindow.addEventListener("keydown", (event) => {
        if (event.target.matches?.("input, textarea, select")) return;
        const copy = new KeyboardEvent("keydown", { key: event.key, shiftKey: event.shiftKey, ctrlKey: event.ctrlKey, metaKey: event.metaKey, altKey: event.altKey, bubbles: true, cancelable: true });
        if (!document.body.dispatchEvent(copy)) event.preventDefault();
      });
    });
    byId("scene").append(this.#frame);
  }

  /** The view from which a session is first seen. */
  reset() {
    this.#frame?.contentWindow.location.reload();
  }

  #without() {
    this.#isMissing = true;
    byId("layers").hidden = true;
    const text = "This browser offers no WebGL 2. Images, numbers and the timeline work without it.";
    document.querySelector(".scene-wait").remove();
    byId("scene").append(make("div", { class: "empty" }, make("h2", {}, "No 3-D scene"), make("p", {}, text)));
  }
}
