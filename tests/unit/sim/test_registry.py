"""Effects by name: unused effects are not imported; an unknown name is an error."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.sim.effects.base import Effects, settings
from splatbot.sim.effects.depth_noise import DepthNoise
from splatbot.sim.effects.registry import EFFECTS, _value, effect_class, make_effect, make_effects
from tests.unit.sim.frames import frame_at


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_is_known_by_its_own_name_and_can_say_what_it_is(name: str) -> None:
    effect = make_effect(name)
    assert effect.name == name
    assert (effect_class(name).__doc__ or "").splitlines()[0].endswith(".")
    (row,) = Effects([effect]).report()
    assert row["settings"] == settings(effect)
    assert row["settings"]
    assert name in row["why"]


@pytest.mark.parametrize("name", EFFECTS)
def test_every_setting_can_be_written_in_a_spec(name: str) -> None:
    spec = f"{name}:" + ",".join(f"{key}={value}" for key, value in settings(effect_class(name)).items())
    assert settings(make_effect(spec)) == settings(make_effect(name))


@pytest.mark.parametrize(("text", "value"), [("true", True), ("False", False)])
def test_a_setting_of_type_bool_is_true_or_false(text: str, value: bool) -> None:
    assert _value("lens", "flipped", text, bool) is value
    with pytest.raises(InputError, match="true or false"):
        _value("lens", "flipped", "0.5", bool)


def test_a_spec_sets_what_it_names_and_leaves_the_rest() -> None:
    effect = make_effect("exposure: step=2, at=40")
    assert settings(effect) == {"step": 2.0, "offset": 0.0, "at": 40, "until": 0, "drift": 0.0}
    assert effect.why == "requested as exposure: step=2, at=40"


@pytest.mark.parametrize(
    ("spec", "field", "hint"),
    [
        ("exposre", "effect", "exposure"),
        ("exposure:stp=2", "effect exposure", "step="),
        ("exposure:step", "effect exposure", "step="),
        ("exposure:step=two", "effect exposure: step", "a number"),
        ("blackout:at=1.5", "effect blackout: at", "a whole number"),
        ("depth_holes:share=2", "effect depth_holes: share", "0..1"),
        ("exposure:why=me", "effect exposure", "step="),
    ],
)
def test_a_wrong_spec_is_named_with_what_would_do(spec: str, field: str, hint: str) -> None:
    with pytest.raises(InputError) as caught:
        make_effect(spec)
    assert caught.value.field == field
    assert hint in (caught.value.hint or "")


def test_one_effect_more_changes_no_others_draws() -> None:
    alone, among = make_effects(["depth_noise"]), make_effects(["depth_holes", "exposure", "depth_noise"])
    a, b = alone(frame_at(index=4)), among(frame_at(index=4))
    assert np.array_equal(a.depth[b.valid], b.depth[b.valid])


def test_an_effect_that_is_on_twice_draws_twice() -> None:
    once, twice = Effects([DepthNoise(step=0)]), Effects([DepthNoise(step=0), DepthNoise(step=0)])
    spread = [float(effects(frame_at()).depth.std()) for effects in (once, twice)]
    assert spread[1] == pytest.approx(np.sqrt(2) * spread[0], rel=0.05)


@pytest.mark.parametrize(
    ("query", "imported"),
    [("", []), ("&effects=exposure", ["exposure"]), ("&effects=blackout;depth_holes", ["blackout", "depth_holes"])],
)
def test_only_the_effects_that_are_required_are_imported(query: str, imported: list[str]) -> None:
    program = (
        "import sys\nfrom splatbot.logs import open_log\n"
        f"open_log('synthetic:wall_blank?frames=2&width=16&height=16{query}')[1]\n"
        f"print('ON', sorted(n for n in {EFFECTS!r} if f'splatbot.sim.effects.{{n}}' in sys.modules))\n"
        "print('SIM', any(m.startswith('splatbot.sim') for m in sys.modules))"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert answer.stdout.splitlines() == [f"ON {imported}", f"SIM {bool(query)}"]


def test_an_effect_that_is_off_is_never_called(monkeypatch: pytest.MonkeyPatch) -> None:
    def called(*_: object) -> None:
        raise AssertionError("is not used")

    for name in set(EFFECTS) - {"exposure"}:
        monkeypatch.setattr(effect_class(name), "apply", called)
    assert make_effects(["exposure:step=2"])(frame_at(rgb=50)).rgb[0, 0, 0] == 100
