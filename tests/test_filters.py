import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvsviz.events.events import Events
from dvsviz.events.filters import EventFilter, FilterConfig, count_pixels, hot_pixels

W, H = 13, 7


def random_events(n: int, seed: int, span_us: int) -> Events:
    rng = np.random.default_rng(seed)
    events = Events(
        t_us=np.sort(rng.integers(0, span_us, n)).astype(np.int64),
        x_px=rng.integers(0, W, n).astype(np.uint16),
        y_px=rng.integers(0, H, n).astype(np.uint16),
        is_positive=rng.integers(0, 2, n).astype(bool),
    )
    for column in (events.t_us, events.x_px, events.y_px, events.is_positive):
        column.setflags(write=False)
    return events


def obvious(events: Events, config: FilterConfig, hot: np.ndarray) -> list[int]:
    """The definition, written without any care for speed."""
    seen: dict[tuple[int, int], int] = {}
    kept: dict[tuple[int, int], int] = {}
    out = []
    for i in range(len(events)):
        t, x, y = int(events.t_us[i]), int(events.x_px[i]), int(events.y_px[i])
        if config.hot_pixels and hot[y, x]:
            continue
        around = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy]
        supported = any(q in seen and seen[q] >= t - (config.background_us or 0) for q in around)
        seen[x, y] = t
        if config.background_us and not supported:
            continue
        if config.refractory_us and (x, y) in kept and t - kept[x, y] < config.refractory_us:
            continue
        kept[x, y] = t
        out.append(i)
    return out


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(0, 400),
    seed=st.integers(0, 10**6),
    hot=st.booleans(),
    background=st.none() | st.integers(1, 3000),
    refractory=st.none() | st.integers(1, 20_000),
    cut=st.integers(1, 400),
)
def test_agrees_with_the_definition_however_cut(n, seed, hot, background, refractory, cut) -> None:
    events = random_events(n, seed, 50_000)
    config = FilterConfig(hot_pixels=hot, background_us=background, refractory_us=refractory)
    mask = np.zeros((H, W), bool)
    mask[2, 9] = mask[6, 0] = True
    expected = obvious(events, config, mask)
    act = EventFilter(W, H, config, mask)
    parts = [act(events[first : first + cut]) for first in range(0, n, cut)]
    times = [t for part in parts for t in part.t_us.tolist()]
    assert times == events.t_us[expected].tolist()
    assert [x for part in parts for x in part.x_px.tolist()] == events.x_px[expected].tolist()
    assert (act.seen, act.kept) == (n, len(expected))


def test_hot_pixels_known_answer() -> None:
    events = random_events(5000, 1, 10**6)
    counts = np.zeros((H, W), np.int64)
    count_pixels(counts, events)
    assert counts.sum() == 5000 and counts[3, 5] == np.sum((events.x_px == 5) & (events.y_px == 3))
    assert not hot_pixels(counts).any()
    counts[6, 12] *= 20
    found = hot_pixels(counts)
    assert found[6, 12] and found.sum() == 1
    edge = np.zeros((H, W), np.int64)
    edge[:, 5:8] = 500
    assert not hot_pixels(edge).any(), "an edge three pixels wide is no row of hot pixels"


def test_wrong_settings() -> None:
    with pytest.raises(ValueError, match="background_us: expected 1 to"):
        FilterConfig(background_us=0)
    with pytest.raises(ValueError, match="hot: expected a mask"):
        EventFilter(W, H, FilterConfig(hot_pixels=True))
    assert not FilterConfig().is_active and FilterConfig(refractory_us=5).is_active
