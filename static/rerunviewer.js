// What the page asks of rerun's web viewer (version 0.41): to show a recording, and to go to a window of it. The second is
// `set_time_cursor {timeline, time, play_state}` of rerun's Viewer Control API, which is taken as a protocol buffer.

const SET_TIME = 6;
const PAUSED = 1;
const TIMELINE = "window";
const RETRY_MS = 100;
const PATIENCE_MS = 60_000;

const number = (value) => (value < 128 ? [value] : [(value % 128) + 128, ...number(Math.floor(value / 128))]);
const whole = (field, value) => [...number(field * 8), ...number(value)];
const part = (field, bytes) => [...number(field * 8 + 2), ...number(bytes.length), ...bytes];

/** Shows the bytes of a recording. The viewer fetches addresses without cookies: it could not ask this server for one. */
export function showRecording(handle, bytes, name) {
  handle.open_channel(name, name);
  handle.send_rrd_to_channel(name, bytes);
  handle.close_channel(name);
}

/** Sets the time of the open recording to a window, and stops it there. */
export async function setWindow(handle, window) {
  const timeline = part(1, [...new TextEncoder().encode(TIMELINE)]);
  const message = new Uint8Array(part(SET_TIME, [...part(2, timeline), ...part(3, whole(1, window)), ...whole(5, PAUSED)]));
  const until = performance.now() + PATIENCE_MS;
  for (;;) {
    try {
      return await handle.viewer_control(message);
    } catch (error) {
      // A large recording is still being read.
      if (performance.now() > until) throw error;
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    }
  }
}
