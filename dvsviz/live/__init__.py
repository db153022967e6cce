"""Streams: recordings served over the network in their own time, and cameras and streams that are tracked live."""
