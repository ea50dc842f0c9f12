"""The list of fields is read off the records: nothing in it is said a second time, and nothing is left out."""

import re
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import pytest

from spacesim.cli.fields import fields_of, meanings, reference
from spacesim.cli.train import OPTIONS
from spacesim.data.structure import Rules, places_of
from spacesim.data.toml import dotted
from spacesim.nerf.config import NerfConfig
from spacesim.splat.train.config import METHODS, PRESETS, STRATEGIES, TrainConfig, preset, warm_start
from spacesim.splat.train.strategies.support_aware import SupportAwareConfig


@dataclass(frozen=True)
class Said:
    """A record with comments in every way."""

    behind: int = 1  #: behind it
    bare: str = "#: in a text, no comment"
    #: above it, on
    #: two lines
    above: float = 2.0
    spread: tuple[int, int] = (
        1,  # not this
        2,
    )  #: behind its end
    both: int = 3  #: and this
    # no meaning


def test_comments_are_found_wherever_they_stand():
    assert meanings(Said) == {
        "behind": "behind it",
        "bare": "",
        "above": "above it, on two lines",
        "spread": "behind its end",
        "both": "and this",
    }


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_field_has_a_meaning(method, strategy):
    config = preset("fine", method, strategy)
    found = list(fields_of(config))
    assert [field.key for field in found if not field.meaning] == []
    assert {f.name for f in fields(TrainConfig)} <= {field.key for field in found}
    assert {key for key, _ in OPTIONS.values()} <= {field.key for field in found}


def test_what_cannot_be_set_is_no_option():
    found = {field.key for field in fields_of(preset("fine", "baseline-park"))}
    assert "light.shadow.method.beta_min" in found
    assert "light.shadow.method.baseline" not in found
    assert "baseline-park" in reference()
    assert "`baseline`" not in reference()


def records_in(record: Any) -> set[str]:
    """Names of the classes of a record and of those within it."""
    inner = [getattr(record, f.name) for f in fields(record)]
    return {type(record).__name__}.union(*(records_in(value) for value in inner if is_dataclass(value)))


def test_the_reference_has_a_table_for_each_record():
    shown = reference()
    tables = re.findall(r"^## (\w+)$", shown, re.MULTILINE)
    assert shown.count("\n## ") + 1 == len(tables) == len(set(tables))
    presets = [preset(name, method, strategy) for name in PRESETS for method in METHODS for strategy in STRATEGIES]
    used = {record for config in presets for record in records_in(replace(config, warm_start=warm_start("fast")))}
    assert len(used) >= 15
    assert used - set(tables) == set()
    says = "strength lambda_b of the receiver-depth bias (4.26), 0: none but that of `grazing`"
    row = f"| `light.shadow.bias` | number | `10` | {says} |"
    assert row in shown
    assert r"| `init` | mesh \| points \| random \| none | `none` |" in shown
    assert "`light.shadow.method` (`splatting`)" in shown
    assert "| `light.field.inputs.sun.kind`, `light.field.inputs.view.kind`, `light.shadow.refine.sun.kind` |" in shown
    assert "| `grid.levels`, `coarse.grid.levels`, `fine.grid.levels` |" in reference(NerfConfig)
    for config in TrainConfig, NerfConfig:
        keys = re.findall(r"^\| (`.+?`) \|", reference(config), re.MULTILINE)
        names = {name for some in keys for name in re.findall(r"`([^`]+)`", some)}
        places = {dotted(place) for place in places_of(config, Rules())}
        assert names == places - {"light.shadow.method.baseline"}  # which is no option
    own = shown.split("## SupportAwareConfig\n")[1].split("\n## ")[0]
    assert re.findall(r"^\| `strategy\.(\w+)`", own, re.MULTILINE) == [f.name for f in fields(SupportAwareConfig)]
    assert f"| `warm_start.steps` | whole number | `{warm_start('thesis').steps}` |" in shown
