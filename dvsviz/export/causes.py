"""What each cause of a failure means, for readers without the dashboard; `static/causes.js` says the same."""

from __future__ import annotations

from dataclasses import dataclass

from dvsviz.session.records import Cause


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """A cause explained.

    Attributes:
        name: in a few words.
        means: what happened.
        told_from: which stored figures say so.
        todo: what can be done about it.
    """

    name: str
    means: str
    told_from: str
    todo: str


EXPLANATIONS: dict[Cause, Explanation] = {
    Cause.TOO_FEW_EVENTS: Explanation(
        name="too few events",
        means=(
            "The window holds so few events that no edge can be seen in it: nothing moved, the scene was "
            "dark, or events were filtered away."
        ),
        told_from="Fewer than 300 events in the window. Look at the curves “events” and “occupied”.",
        todo=(
            "Gather longer windows, filter less, or lower the sensor's thresholds. A camera that stands "
            "still loses nothing: tracking goes on when it moves."
        ),
    ),
    Cause.TOO_LITTLE_TEXTURE: Explanation(
        name="too little texture",
        means=("There are events, but not enough edges to fix six parameters by: a bare wall, one line, noise."),
        told_from=(
            "Fewer than 150 edge pixels in the warped window. Look at “warped”: edges would be bright lines."
        ),
        todo=(
            "Keep something with edges in view. Fewer free parameters need fewer edges: try again from here "
            "with translation or rotation only."
        ),
    ),
    Cause.WEAK_DIRECTION: Explanation(
        name="a direction that the texture cannot see",
        means=(
            "The edges in view move alike under two motions (a turn about y and a move along x, say), or not"
            " at all along one: any mixture fits as well."
        ),
        told_from=(
            "The condition of the pose's normal matrix is above 30,000; its weakest eigenvector names the "
            "motion. It is “seen least” among the numbers."
        ),
        todo=(
            "Open the landscape (G): it shows the ridge. More depth or edges in another direction end it; a "
            "motion model without the parameter that cannot be seen avoids it."
        ),
    ),
    Cause.LEFT_MAP: Explanation(
        name="left the map",
        means=(
            "The camera looks at a part of the plane, or past its edge, where the map has not been drawn yet"
            " or was never seen."
        ),
        told_from="Less than 40 % of the window's events fall on the map.",
        todo=(
            "Look at “on map”: where the map ends, so does what can be known. Come back to what was seen, or"
            " move more slowly, so that the map grows first."
        ),
    ),
    Cause.TOO_FAST: Explanation(
        name="faster than the search",
        means=(
            "From one window to the next the image moved farther than the search reaches, so that it started"
            " beside the right answer."
        ),
        told_from=(
            "The estimated motion moves the image by more than 12 px in one window, or smears edges that are sharper"
            " without it, or a lost window's own motion lies more than 6 px from the one it was tracked with."
        ),
        todo=(
            "Take shorter windows (fewer events), or give the pose by hand: try again from here and drag the"
            " camera."
        ),
    ),
    Cause.LOCAL_OPTIMUM: Explanation(
        name="a local optimum",
        means=(
            "The estimate stands on a summit of the objective, but there is a higher one, or the truth lies "
            "elsewhere."
        ),
        told_from=(
            "Within a quarter of a second the camera was found again close to where it was lost. The "
            "landscape (G) marks estimate, prior, truth and the summit."
        ),
        todo=(
            "Try again from here with the pose dragged towards the summit, or with another objective or "
            "window size."
        ),
    ),
    Cause.MAP_POLLUTED: Explanation(
        name="the map is polluted",
        means=(
            "Edges were drawn into the map with wrong poses: it shows things twice, and windows fit the wrong copy."
        ),
        told_from=(
            "The window fits neither from the estimated nor from the true pose. Compare “on map” with “true "
            "pose on map”."
        ),
        todo=("Go back to the last keyframe before the map went wrong (K, ⇧ K) and try again from there."),
    ),
    Cause.NOT_PLANAR: Explanation(
        name="the scene is not planar",
        means="What is seen lies at several depths: no plane explains how all edges move.",
        told_from=(
            "In the first windows one plane did not explain the motion; “residual” shows edges left over in one "
            "part of the image."
        ),
        todo=("Use the motion models auto or translation, which know depth, or keep the camera before one plane."),
    ),
    Cause.UNKNOWN: Explanation(
        name="not known",
        means="The events no longer fit the map, and none of the figures that were stored says why.",
        told_from=(
            "The score fell below 45 % of what it is when tracking is good (weak: below 70 %), with enough "
            "events, texture and map."
        ),
        todo=(
            "Compare “on map” with “true pose on map” where truth is known: does the second fit, the pose is"
            " wrong, else the map or the plane. Then look at the landscape (G)."
        ),
    ),
}
