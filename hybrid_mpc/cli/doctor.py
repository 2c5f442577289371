"""``hybrid-mpc doctor``: what is installed, and what of this computer a job will use."""

from __future__ import annotations

import typer

WRONG = 1
"""Exit code where a job could not run."""


def doctor() -> None:
    """Versions of packages and extras, compiler, threads, GPU, and whether caches can be written.

    Exit code 1 if a job could not run.
    """
    from hybrid_mpc.check.doctor import examined

    findings = examined()
    width = max(len(one.name) for one in findings)
    for one in findings:
        mark = {"ok": " ", "absent": "-", "wrong": "!"}[one.state]
        print(
            f"{mark} {one.name:{width}}  {one.found}"
            + (f"\n  {'':{width}}  -> {one.remedy}" if one.remedy else "")
        )
    if any(one.state == "wrong" for one in findings):
        raise typer.Exit(WRONG)
