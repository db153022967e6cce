// A worker that decodes images, so that the page's thread, which the 3-D scene may keep busy, does not.
// The bitmaps of one window go back together.

self.onmessage = async ({ data: { job, images } }) => {
  try {
    const bitmaps = await Promise.all(images.map(({ data, mime }) => createImageBitmap(new Blob([data], { type: mime }))));
    self.postMessage({ job, bitmaps }, bitmaps);
  } catch (error) {
    self.postMessage({ job, bitmaps: [], error: String(error) });
  }
};
