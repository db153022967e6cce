// What each cause of a failure means, which stored figures it is told from, and what can be done; docs/failures.md says the same.

export const CAUSES = {
  too_few_events: {
    name: "too few events",
    means: "The window holds so few events that no edge can be seen in it: nothing moved, the scene was dark, or events were filtered away.",
    from: "Fewer than 300 events in the window. Look at the curves “events” and “occupied”.",
    todo: "Gather longer windows, filter less, or lower the sensor's thresholds. A camera that stands still loses nothing: tracking goes on when it moves.",
  },
  too_little_texture: {
    name: "too little texture",
    means: "There are events, but not enough edges to fix six parameters by: a bare wall, one line, noise.",
    from: "Fewer than 150 edge pixels in the warped window. Look at “warped”: edges would be bright lines.",
    todo: "Keep something with edges in view. Fewer free parameters need fewer edges: try again from here with translation or rotation only.",
  },
  weak_direction: {
    name: "a direction that the texture cannot see",
    means: "The edges in view move alike under two motions (a turn about y and a move along x, say), or not at all along one: any mixture fits as well.",
    from: "The condition of the pose's normal matrix is above 30,000; its weakest eigenvector names the motion. It is “seen least” among the numbers.",
    todo: "Open the landscape (G): it shows the ridge. More depth or edges in another direction end it; a motion model without the parameter that cannot be seen avoids it.",
  },
  left_map: {
    name: "left the map",
    means: "The camera looks at a part of the plane, or past its edge, where the map has not been drawn yet or was never seen.",
    from: "Less than 40 % of the window's events fall on the map.",
    todo: "Look at “on map”: where the map ends, so does what can be known. Come back to what was seen, or move more slowly, so that the map grows first.",
  },
  too_fast: {
    name: "faster than the search",
    means: "From one window to the next the image moved farther than the search reaches, so that it started beside the right answer.",
    from: "The estimated motion moves the image by more than 12 px in one window, or smears edges that are sharper without it, or a lost window's own motion lies more than 6 px from the one it was tracked with.",
    todo: "Take shorter windows (fewer events), or give the pose by hand: try again from here and drag the camera.",
  },
  local_optimum: {
    name: "a local optimum",
    means: "The estimate stands on a summit of the objective, but there is a higher one, or the truth lies elsewhere.",
    from: "Within a quarter of a second the camera was found again close to where it was lost. The landscape (G) marks estimate, prior, truth and the summit.",
    todo: "Try again from here with the pose dragged towards the summit, or with another objective or window size.",
  },
  map_polluted: {
    name: "the map is polluted",
    means: "Edges were drawn into the map with wrong poses: it shows things twice, and windows fit the wrong copy.",
    from: "The window fits neither from the estimated nor from the true pose. Compare “on map” with “true pose on map”.",
    todo: "Go back to the last keyframe before the map went wrong (K, ⇧ K) and try again from there.",
  },
  not_planar: {
    name: "the scene is not planar",
    means: "What is seen lies at several depths: no plane explains how all edges move.",
    from: "In the first windows one plane did not explain the motion; “residual” shows edges left over in one part of the image.",
    todo: "Use the motion models auto or translation, which know depth, or keep the camera before one plane.",
  },
  unknown: {
    name: "not known",
    means: "The events no longer fit the map, and none of the figures that were stored says why.",
    from: "The score fell below 45 % of what it is when tracking is good (weak: below 70 %), with enough events, texture and map.",
    todo: "Compare “on map” with “true pose on map” where truth is known: does the second fit, the pose is wrong, else the map or the plane. Then look at the landscape (G).",
  },
};

/** A cause in words. */
export const causeName = (cause) => CAUSES[cause]?.name ?? cause.replaceAll("_", " ");
