"""Segmentation of a map into support planes and objects."""

from splatbot.segmentation.clusters import clusters
from splatbot.segmentation.fits import Fit, fit, primitive_fits
from splatbot.segmentation.objects import MapObject, SegmentedMap, segment
from splatbot.segmentation.plane import Support, find_support, given_support

__all__ = [
    "Fit",
    "MapObject",
    "SegmentedMap",
    "Support",
    "clusters",
    "find_support",
    "fit",
    "given_support",
    "primitive_fits",
    "segment",
]
