"""Views of maps: virtual ones see the map from all sides."""

from __future__ import annotations

import numpy as np

from splatbot.rasterize.views import render_view
from splatbot.training.map_views import MapViews, around
from splatbot.training.options import TrainingOptions
from tests.unit.training.rendered import rendered_data, true_model


def test_virtual_views_see_the_map_from_all_sides() -> None:
    model = true_model()
    views = around(model, 12, width=64, height=48)
    looks = np.array([T[:3, 2] for _, T in views])
    assert np.linalg.norm(looks.mean(axis=0)) < 0.1
    for camera, T in views:
        alpha = render_view(model, camera, T, "alpha")
        assert alpha.max() > 0.9
        assert alpha[20:28, 28:36].mean() > 2 * alpha[:, 0].mean()  # the map is in the middle
        assert T[1, 1] > 0  # y of the image is down, as that of the world


def test_a_map_scores_well_against_photographs_of_itself() -> None:
    data = rendered_data(8)
    mapped, held_out = data.split(4)
    views = MapViews(data, mapped, held_out, TrainingOptions(iterations=1), "photographs")
    scores = views.score(true_model(), 1)
    assert scores["held_out"] == 1
    assert scores["psnr_db"] > 40
    assert views.score(true_model(), 0)["psnr_db"] is None
