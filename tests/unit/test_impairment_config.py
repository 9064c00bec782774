"""`[impairment]` of `lab.toml`: kinds as text or table, presets, schedules, and errors."""

from pathlib import Path

import pytest

from hilrig_runtime.config.impairment import (
    PRESETS,
    BernoulliLoss,
    ConstantDelay,
    GammaDelay,
    GilbertElliottLoss,
    ImpairmentConfig,
    LinkImpairment,
    NormalDelay,
    TraceDelay,
    UniformDelay,
)
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import InputError


def test_default_is_no_impairment() -> None:
    lab = parse_lab("")
    assert lab.impairment_of(lab.rigs[0]).links.is_inactive
    assert lab.impairment.links.describe() == "none"


@pytest.mark.parametrize(
    ("text", "delay"),
    [
        ("constant:10", ConstantDelay(delay_ms=10)),
        ("constant", ConstantDelay()),
        ("uniform:5, 20", UniformDelay(low_ms=5, high_ms=20)),
        ("normal:20,5", NormalDelay(mean_ms=20, std_ms=5)),
        ("gamma:20,8", GammaDelay(mean_ms=20, std_ms=8)),
        ("gamma:20,8,2.5", GammaDelay(mean_ms=20, std_ms=8, offset_ms=2.5)),
    ],
)
def test_delay_text_has_kind_and_numbers(text: str, delay: object) -> None:
    assert LinkImpairment.model_validate(text).delay == delay


def test_text_and_table_forms_are_equal() -> None:
    as_text = parse_lab('[impairment]\ncommand = { delay = "gamma:20,8", loss = "gilbert:0.01,0.2" }\n')
    as_table = parse_lab(
        '[impairment.command.delay]\nkind = "gamma"\nmean_ms = 20\nstd_ms = 8\n'
        '[impairment.command.loss]\nkind = "gilbert"\nto_bad = 0.01\nto_good = 0.2\n'
    )
    assert as_text.impairment == as_table.impairment
    assert as_text.impairment.links.command.loss == GilbertElliottLoss(to_bad=0.01, to_good=0.2)
    assert as_text.impairment.links.describe() == (
        "state link none; command link gamma mean 20 ms, std 8 ms, loss gilbert to bad 0.01, to good 0.2"
    )


def test_setting_of_a_link_overrides_its_preset() -> None:
    links = ImpairmentConfig.model_validate({"preset": "vpn", "state": {"loss": "bernoulli:0.5"}}).links
    assert links.command == PRESETS["vpn"].command
    assert links.state == LinkImpairment(loss=BernoulliLoss(rate=0.5))


def test_rig_can_have_its_own_impairment() -> None:
    lab = parse_lab(
        '[impairment]\npreset = "mobile"\n[[rigs]]\nname="a"\n[[rigs]]\nname="b"\nimpairment.preset = "none"\n'
    )
    assert [lab.impairment_of(rig).preset for rig in lab.rigs] == ["mobile", "none"]


def test_description_of_impairment() -> None:
    assert ImpairmentConfig().describe() == "none"
    config = ImpairmentConfig.model_validate(
        {"command": "constant:5", "schedule": [{"at_s": 2.5, "state": "uniform:1,2"}, {"at_s": 9}]}
    )
    assert config.describe() == (
        "state link none; command link constant delay 5 ms, then at 2.5 s state link uniform low 1 ms, high 2 ms; "
        "command link none, then at 9 s none"
    )


def test_setting_round_trips_through_json() -> None:
    for preset in PRESETS:
        config = ImpairmentConfig.model_validate(
            {"preset": preset, "state": "constant:3", "schedule": [{"at_s": 1, "preset": "vpn"}]}
        )
        assert ImpairmentConfig.model_validate_json(config.model_dump_json()) == config


def test_trace_file_has_one_delay_per_line(tmp_path: Path) -> None:
    trace = tmp_path / "trace.txt"
    trace.write_text("# delays of a session, ms\n12.5\n3\n1e1\n")
    way = LinkImpairment.model_validate(f"trace:{trace}")
    assert way.delay == TraceDelay(delays_ms=(12.5, 3.0, 10.0))
    assert way.describe() == "trace of 3 delays, mean 8.5 ms"


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ("1\n\n2\n", r"trace.txt, line 2: must be a delay from 0 to 10000 ms, got ''"),
        ("1\nnan\n", r"line 2: .* got 'nan'"),
        ("1\n-3\n", r"line 2: .* got '-3'"),
        ("1\n2,5\n", r"line 2: .* got '2,5'"),
        ("# nothing\n", r"contains no delay"),
        (None, "no such file"),
    ],
)
def test_trace_with_invalid_line_is_rejected(tmp_path: Path, lines: str | None, complaint: str) -> None:
    trace = tmp_path / "trace.txt"
    if lines is not None:
        trace.write_text(lines)
    with pytest.raises(InputError, match=complaint):
        parse_lab(f"[impairment]\nstate = 'trace:{trace}'\n")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("preset = 'wlan'", r"impairment\.preset: unknown preset 'wlan'; must be one of none, wired"),
        ("state = 'constant:-3'", r"state\.delay\.constant\.delay_ms: must be ≥ 0, got '-3'"),
        ("state = 'constant:20ms'", r"state\.delay\.constant\.delay_ms: must be a number, got '20ms'"),
        ("state = 'constant:nan'", r"delay_ms: must be a finite number"),
        ("state = 'constant:20000'", r"delay_ms: must be ≤ 10000, got '20000'"),
        ("state = 'poisson:3'", r"impairment\.state\.delay: unknown delay 'poisson'; must be one of constant"),
        ("state = 'uniform:5'", r"uniform needs low_ms, high_ms, got 'uniform:5'"),
        ("state = 'gamma:5,2,1,1'", r"gamma needs mean_ms, std_ms, \[offset_ms\], got"),
        ("state = 'uniform:9,5'", r"low_ms must be ≤ high_ms, got 9 and 5"),
        ("command.loss = 'bernoulli:1.5'", r"rate: must be ≤ 1, got '1.5'"),
        ("command.loss = 'gilbert:0.1,0'", r"to_good: must be > 0"),
        ("command.loss = 'none:1'", r"none needs no numbers"),
        ("command.jitter = 3", r"impairment\.command\.jitter: unknown key"),
        ("seed = -1", r"impairment\.seed: must be ≥ 0"),
        ("schedule = [{ preset = 'vpn' }]", r"impairment\.schedule\[0\]\.at_s: is missing"),
        ("schedule = [{ at_s = 5 }, { at_s = 5 }]", r"at_s must increase, got 5 after 5"),
        ("schedule = [{ at_s = -5 }]", r"schedule\[0\]\.at_s: must be ≥ 0"),
    ],
)
def test_invalid_value_is_reported_with_its_place(text: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        parse_lab(f"[impairment]\n{text}\n")


def test_page_agrees_with_the_models() -> None:
    page = (Path(__file__).parents[2] / "docs/impairment.md").read_text()
    section = page.partition("# Delay and loss in the live loop")[2]
    example = section.partition("```toml\n")[2].partition("```")[0]
    impairment = parse_lab(example).impairment
    assert impairment.links.command == LinkImpairment.model_validate(
        {"delay": "gamma:20,8", "loss": "gilbert:0.01,0.3"}
    )
    assert [entry.preset for entry in impairment.schedule] == ["mobile", "none"]
    for name in ("constant", "uniform", "normal", "gamma", "exponential", "trace", "none", "bernoulli", "gilbert"):
        assert f"| `{name}` |" in section
    for preset in PRESETS:
        assert preset == "none" or f"| `{preset}` |" in section
