"""dvsviz: planar event-camera tracking, and a browser dashboard to understand it."""

__version__ = "0.1.0"
