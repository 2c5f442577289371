"""``hybrid-mpc doctor``: installed packages, and the hardware that a job will use."""

from __future__ import annotations

import typer

WRONG = 1
"""Exit code if no job can run."""


def doctor() -> None:
    """Print versions of packages and extras, compiler, threads, GPU, and whether caches are writable.

    Exit code 1 if no job can run.
    """
    from hybrid_mpc.check.doctor import examine

    findings = examine()
    width = max(len(one.name) for one in findings)
    for one in findings:
        mark = {"ok": " ", "absent": "-", "wrong": "!"}[one.state]
        print(
            f"{mark} {one.name:{width}}  {one.found}"
            + (f"\n  {'':{width}}  -> {one.remedy}" if one.remedy else "")
        )
    if any(one.state == "wrong" for one in findings):
        raise typer.Exit(WRONG)
