"""The tutorial from one run of the demo: ``python docs/site/tutorial.py runs/demo``.

Writes docs/site/tutorial.json (the numbers), docs/images/tutorial (the pictures) and docs/tutorial.md. Without a folder
the page is made anew from the stored numbers. The picture of the report needs chromium; without it the old one stays.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import jinja2
from PIL import Image

HERE = Path(__file__).parent
DOCS = HERE.parent
IMAGES = DOCS / "images" / "tutorial"
NUMBERS = HERE / "tutorial.json"
PAGE = DOCS / "tutorial.md"
PICTURES = {
    "free_run.png": "free_run_test_01_sine.png",
    "loop.png": "loop_reject_load.png",
    "fault.png": "fault_friction.png",
}
"""Pictures of the page, and what they are called among the figures of a run."""
SCREEN = 1100, 600
"""Width and height of the report's first screen [px]."""
COLOURS = 64
"""Colours of a kept picture: it looks the same and takes a third of the bytes."""


def digits(value: float, most: int = 3) -> str:
    """A number with so many significant digits, without an exponent.

    Example:
        >>> digits(0.0154111), digits(64.23), digits(3.0, 2)
        ('0.0154', '64.2', '3')
    """
    text = f"{float(f'{value:.{most}g}'):f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def kept(value: Any) -> Any:
    """Numbers with six digits, so that the stored file stays readable."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: kept(one) for key, one in value.items()}
    return [kept(one) for one in value] if isinstance(value, list) else value


def numbers(run: Path) -> dict[str, Any]:
    """What the page says of a run, from its results.json and its recordings."""
    from hybrid_mpc import load_scenario
    from hybrid_mpc.workflow.stages.results import read_results

    found = read_results(run / "results.json")
    prior = load_scenario(found.scenario).prior()
    fit, choice = found.prior.fit, found.choice.choice
    chosen = choice.candidates[choice.recommended]
    roles = [name.partition("_")[0] for name in found.data.files]
    loops, ms, watch = found.control, found.control.step_ms, found.watch
    shown = {
        "recordings": {role: roles.count(role) for role in ("train", "valid", "test")},
        "head": "\n".join((run / "data" / "train_01_sine.csv").read_text().splitlines()[:3]),
        "parameters": [
            {"name": p.name, "unit": p.unit, "nominal": found.prior.nominal[p.name], "fitted": fit.values[p.name],
             "standard_error": fit.standard_errors[p.name]}
            for p in prior.parameters if not p.fixed
        ],
        "warnings": list(fit.warnings),
        "rmse": {name: own.model.rmse[prior.outputs[0].label] for name, own in found.evaluation.scores.items()},
        "choice": {"name": choice.recommended.upper(), "share": round(100 * chosen.share), "ratio": chosen.ratio,
                   "upper": chosen.upper},
        "loops": {
            "seeds": loops.most_seeds,
            "tasks": [
                {"name": name, "prior": by["prior_observer"].cost.mean, "hybrid": by["hybrid_observer"].cost.mean,
                 **{key: getattr(loops.comparisons[name]["prior_observer"], key) for key in ("ratio", "low", "high")}}
                for name, by in loops.means.items()
            ],
        },
        "step": {"median": ms.median, "p99": ms.p99, "period": ms.period},
        "watch": {
            "clean": watch.clean.seconds,
            "clean_alarms": watch.clean.alarms,
            "faults": [
                {"title": f.title, "delay": f.delay_s, "diagnosis": f.diagnosis.partition(", which")[0]}
                for f in watch.faults
            ],
        },
    }  # fmt: skip
    return dict(kept(shown))


def page(shown: dict[str, Any]) -> str:
    """The page's text for the numbers of a run."""
    made = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False)
    made.filters["digits"] = digits
    return made.from_string((HERE / "tutorial.md.j2").read_text()).render(shown)


def smaller(source: Path, target: Path) -> None:
    """A picture with few colours."""
    image = Image.open(source).convert("RGB")
    kind = Image.Quantize.MAXCOVERAGE
    image.quantize(COLOURS, kind, dither=Image.Dither.NONE).save(target, optimize=True)


def pictures(run: Path) -> None:
    """Copy the pictures of a run, and take one of its report's first screen."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name, figure in PICTURES.items():
        smaller(run / "figures" / figure, IMAGES / name)
    if shutil.which("chromium") is None:
        print("no chromium: images/tutorial/report.png stays as it is")
        return
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "report.png"
        width, height = SCREEN
        subprocess.run(
            ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
             "--virtual-time-budget=6000", f"--window-size={width},{height}", f"--screenshot={shot}",
             (run / "report.html").resolve().as_uri()],
            check=True, capture_output=True, timeout=120,
        )  # fmt: skip
        smaller(shot, IMAGES / "report.png")


def main() -> None:
    """Numbers, pictures and page of a run; the page alone without one."""
    if len(sys.argv) > 1:
        run = Path(sys.argv[1])
        NUMBERS.write_text(json.dumps(numbers(run), indent=1, ensure_ascii=False) + "\n")
        pictures(run)
    PAGE.write_text(page(json.loads(NUMBERS.read_text())))


if __name__ == "__main__":
    main()
