"""Settings: from flags and files, checked, and written with their reasons."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace

import pytest
from conftest import SMALL, refusal, run_command

from caryatid.config import Config, FitConfig
from caryatid.config.settings import field_docs, read_settings
from caryatid.errors import InputError


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "settings.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_a_flag_beats_the_file_the_file_the_base_and_the_base_the_default(file):
    assert read_settings(None, []) == Config()
    base = replace(Config(), fit=replace(FitConfig(), hypotheses=30, threshold=0.03, steps=7))
    config = read_settings(file("[fit]\nhypotheses = 50\nthreshold = 0.02\n"), ["fit.hypotheses=70"], base)
    assert (config.fit.hypotheses, config.fit.threshold, config.fit.steps) == (70, 0.02, 7)
    assert config.fit.max_points == FitConfig().max_points
    assert replace(config, fit=FitConfig()) == Config()


@pytest.mark.parametrize(
    ("flag", "stage", "name", "value"),
    [
        ('fusion.method="pc+sg"', "fusion", "method", "pc+sg"),
        ("fusion.method=pc+sg", "fusion", "method", "pc+sg"),
        ("registration.enabled=false", "registration", "enabled", False),
        ("fit.threshold=1", "fit", "threshold", 1.0),
        ("robot.pitch=[-50, 10]", "robot", "pitch", (-50.0, 10.0)),
        # The ends of a range belong to it.
        ("noise.translation=0", "noise", "translation", 0.0),
        ("robot.pitch=[10, 10]", "robot", "pitch", (10.0, 10.0)),
    ],
)
def test_values_are_written_as_in_toml_or_as_bare_words(flag, stage, name, value):
    found = getattr(getattr(read_settings(None, [flag]), stage), name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("flag", "said"),
    [
        ("fits.steps=3", ("--set fits.steps=3: unknown setting", "fit,", "voxels")),
        ("fit.step=3", ("--set fit.step=3: unknown setting", "steps", "threshold")),
        *((flag, ("--set: expected STAGE.NAME=VALUE", flag)) for flag in ("fit.steps", "steps=3", "a.b.c=3")),
    ],
)
def test_an_unknown_name_lists_the_valid_ones_and_half_a_flag_what_is_whole(flag, said):
    with refusal(*said):
        read_settings(None, [flag])


@pytest.mark.parametrize(
    ("flag", "wanted"),
    [
        ("fit.steps=2.5", "a valid integer"),
        ("fit.threshold=thick", "a valid number"),
        ("fit.threshold=nan", "a finite number"),
        ("registration.enabled=1", "a valid boolean"),
        ("fusion.method=mean", "'pc', 'sg' or 'pc+sg'"),
        ("robot.pitch=[1, 2, 3]", "at most 2 items"),
        ("robot.pitch=[low, 2]", "a valid array"),
        ("voxels.size=0", "greater than 0"),
        ("fit.min_extent=2147483648", "less than or equal to 1"),
        ("split.rounds=65535", "less than or equal to 1000"),
        ("fit.hypotheses=1000000000", "less than or equal to 1000000"),
        ("export.corners=7", "greater than or equal to 8"),
        ("support.touch=1e300", "less than or equal to 1000"),
        ("voxels.extent=[16, 16, 10]", "take 5.12 GB, more than voxels.max_voxels = 64000000"),
        ("fusion.keep_share=1.01", "less than or equal to 1"),
        ("robot.pitch=[20, -60]", "in ascending order"),
        (f"fit.steps={'[' * 5000}", "a valid integer"),
    ],
)
def test_a_value_of_the_wrong_type_or_range_says_what_is_wanted(flag, wanted):
    with pytest.raises(InputError, match=rf"--set {re.escape(flag)}: {flag.split('=')[0]} = ") as caught:
        read_settings(None, [flag])
    assert wanted in caught.value.remedy


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("extract recording --masks . --segmentation auto", "--segmentation auto, which uses no masks"),
        ("extract table.pcd --masks .", "masks need images, and a cloud has none"),
    ],
)
def test_options_that_exclude_each_other_are_refused(words, said, tmp_path, capsys):
    assert run_command(*words.split(), "--out", tmp_path / "run") == 1
    assert said in capsys.readouterr().err


def test_a_demo_starts_from_the_preset_and_flags_change_it(tmp_path):
    options = ("--preset", "paper", "--masks", "per-view", "--views", 1, "--no-report", "--quiet")
    assert run_command("demo", "--out", tmp_path / "run", *options, *SMALL) == 0
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    assert run["options"]["planner"] == "paper"
    assert run["settings"]["support"]["stability"] == "area"
    assert run["settings"]["fusion"]["matching"] == "shapes"
    assert run["settings"]["fusion"]["masks"] == "per-view"


def test_every_number_has_a_range_a_unit_and_a_reason():
    unlimited = {"sensor.light", "arm.base"}  # a direction, and a place
    for stage in fields(Config):
        kind = type(getattr(Config(), stage.name))
        assert all(field_docs(kind).values()), stage.name
        for field in fields(kind):
            value = field.default
            if isinstance(value, bool | str) or f"{stage.name}.{field.name}" in unlimited:
                continue
            beyond = (-1e9,) * len(value) if isinstance(value, tuple) else -(10**9)
            with pytest.raises(ValueError, match=field.name):
                kind(**{field.name: beyond})


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"[fit]\nstep = 3\n", "fit.step"),
        (b"fit = 3\n", "is a table, not a setting"),
        (b"[fit\n", "invalid TOML"),
        (b"[fit]\nsteps = " + b"[" * 5000, "invalid TOML"),
        (b"[fit" + b".steps" * 5000 + b"]\n", "is nested too deeply"),
        (None, "cannot be read"),
    ],
)
def test_a_file_is_named_when_something_in_it_is_wrong(tmp_path, content, reason):
    path = tmp_path / "settings.toml"
    if content is not None:
        path.write_bytes(content)
    with refusal(path, reason):
        read_settings(path, [])
