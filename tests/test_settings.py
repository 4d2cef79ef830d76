from __future__ import annotations

from dataclasses import fields, replace

import pytest

from caryatid.config import (
    Config,
    FitConfig,
    FusionConfig,
    VoxelConfig,
)
from caryatid.config.settings import field_docs, read_settings, write_settings
from caryatid.errors import InputError


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "settings.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_without_file_and_flags_all_is_default():
    assert read_settings(None, []) == Config()


def test_a_flag_beats_the_file_and_the_file_the_default(file):
    path = file("[fit]\nhypotheses = 50\nthreshold = 0.02\n")
    config = read_settings(path, ["fit.hypotheses=70"])
    assert config.fit.hypotheses == 70
    assert config.fit.threshold == 0.02
    assert config.fit.steps == FitConfig().steps
    assert replace(config, fit=FitConfig()) == Config()


def test_what_was_there_is_started_from_and_stays():
    base = replace(Config(), fit=replace(FitConfig(), steps=7))
    config = read_settings(None, ["fit.hypotheses=1"], base)
    assert (config.fit.steps, config.fit.hypotheses) == (7, 1)
    assert base.fit.hypotheses == FitConfig().hypotheses


@pytest.mark.parametrize(
    ("flag", "stage", "name", "value"),
    [
        ("fusion.method=sg", "fusion", "method", "sg"),
        ('fusion.method="pc+sg"', "fusion", "method", "pc+sg"),
        ("fusion.method=pc+sg", "fusion", "method", "pc+sg"),
        ("registration.enabled=false", "registration", "enabled", False),
        ("fit.threshold=1", "fit", "threshold", 1.0),
        ("fit.threshold=1e-3", "fit", "threshold", 0.001),
        ("robot.pitch=[-50, 10]", "robot", "pitch", (-50.0, 10.0)),
    ],
)
def test_values_are_written_as_toml_does_or_as_bare_words(flag, stage, name, value):
    found = getattr(getattr(read_settings(None, [flag]), stage), name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("flag", "listed"),
    [
        ("fits.steps=3", ["fit", "fusion", "voxels"]),
        ("fit.step=3", ["steps", "hypotheses", "threshold"]),
    ],
)
def test_an_unknown_name_lists_the_valid_ones(flag, listed):
    with pytest.raises(InputError, match="there is no setting") as caught:
        read_settings(None, [flag])
    assert f"--set {flag}" in str(caught.value)
    assert all(name in caught.value.remedy.split("there are ")[1].split(", ") for name in listed)


@pytest.mark.parametrize(
    ("flag", "wanted"),
    [
        ("fit.steps=2.5", "a valid integer"),
        ("fit.steps=true", "a valid integer"),
        ("fit.threshold=thick", "a valid number"),
        ("fit.threshold=nan", "a finite number"),
        ("fit.threshold=inf", "a finite number"),
        ("fit.threshold=false", "a valid number"),
        ("registration.enabled=1", "a valid boolean"),
        ("fusion.method=mean", "'pc', 'sg' or 'pc+sg'"),
        ("robot.pitch=[1, 2, 3]", "at most 2 items"),
        ("robot.pitch=5", "a valid array"),
        ("robot.pitch=[low, 2]", "a valid array"),
        ("voxels.size=0", "greater than 0"),
        ("noise.translation=-1", "greater than or equal to 0"),
        ("voxels.hit=1", "less than 1"),
        ("fusion.keep_share=1.01", "less than or equal to 1"),
        ("voxels.extent=[1, 0, 1]", "greater than 0"),
        ("robot.pitch=[20, -60]", "in rising order"),
    ],
)
def test_a_value_of_the_wrong_type_or_range_says_what_is_wanted(flag, wanted):
    name = flag.split("=")[0]
    with pytest.raises(InputError) as caught:
        read_settings(None, [flag])
    assert caught.value.source == f"--set {flag}"
    assert caught.value.reason.startswith(f"{name} = ")
    assert wanted in caught.value.remedy


@pytest.mark.parametrize(
    "flag", ["noise.translation=0", "fusion.keep_share=1", "split.rounds=0", "robot.pitch=[10, 10]"]
)
def test_the_ends_of_a_range_belong_to_it(flag):
    read_settings(None, [flag])


def test_settings_made_in_python_are_checked_too():
    for make in (
        lambda: VoxelConfig(size=0.0),
        lambda: replace(FitConfig(), max_points=0),
        lambda: FusionConfig(keep_share=float("nan")),
    ):
        with pytest.raises(ValueError, match="Input should be"):
            make()


ANY = {"sensor.light", "arm.base"}
"""Settings that may be any number: a direction, and a place."""


def test_every_number_has_a_range_a_unit_and_a_reason():
    for stage in fields(Config):
        kind = stage.default_factory
        assert all(field_docs(kind).values()), stage.name
        for field in fields(kind):
            value = field.default
            if isinstance(value, bool | str) or f"{stage.name}.{field.name}" in ANY:
                continue
            beyond = (-1e9,) * len(value) if isinstance(value, tuple) else -(10**9)
            with pytest.raises(ValueError, match=field.name):
                kind(**{field.name: beyond})


@pytest.mark.parametrize("flag", ["fit", "fit.steps", "steps=3", "a.b.c=3", "=3"])
def test_a_flag_without_stage_name_or_value_is_refused(flag):
    with pytest.raises(InputError, match=r"stage\.name=value"):
        read_settings(None, [flag])


def test_a_file_is_named_when_something_in_it_is_wrong(file):
    for text, reason in [
        ("[fit]\nstep = 3\n", "fit.step"),
        ("[fit]\nsteps = 'three'\n", "fit.steps"),
        ("fit = 3\n", "is a table of settings"),
        ("[fit\n", "is not TOML"),
    ]:
        path = file(text)
        with pytest.raises(InputError, match=r"settings\.toml") as caught:
            read_settings(path, [])
        assert reason in str(caught.value)


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_settings(tmp_path / "none.toml", [])
    with pytest.raises(InputError, match="cannot be read"):
        read_settings(tmp_path, [])
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not TOML"):
        read_settings(binary, [])


def test_what_is_written_is_read_back_as_it_was(file):
    flags = [
        "fusion.method=sg",
        "registration.enabled=false",
        "robot.pitch=[-50.5, 10]",
        "fit.threshold=0.00123",
    ]
    config = read_settings(None, flags)
    path = file(write_settings(config))
    assert read_settings(path, []) == config
    text = path.read_text()
    assert all(f"[{stage.name}]" in text for stage in fields(Config))
    assert "# An object displaced by more than this has been disturbed [m]" in text
    assert read_settings(file(write_settings(Config())), []) == Config()
