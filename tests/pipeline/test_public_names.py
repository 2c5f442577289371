"""What the main job's package offers by name, and that its loops come without torch."""

import subprocess
import sys

import pytest

import hybrid_mpc.pipeline
from hybrid_mpc.pipeline import __all__ as names
from hybrid_mpc.pipeline.loops import make_estimator
from hybrid_mpc.pipeline.run import run

WITHOUT_TORCH = """
import sys
class Refuse:
    def find_spec(self, name, *rest):
        if name.split(".")[0] == "torch":
            raise ImportError("torch is refused here")
sys.meta_path.insert(0, Refuse())
import hybrid_mpc.pipeline
assert "casadi" not in sys.modules  # nothing is loaded before it is asked for
from hybrid_mpc.pipeline import (
    find_noise, make_adaptive_guard, make_controller, make_estimator, make_monitor, make_ocp, tuned_noise,
    working_point,
)
print(make_ocp.__module__)
"""


@pytest.mark.parametrize("name", names)
def test_every_name_is_there_and_documented(name):
    assert getattr(hybrid_mpc.pipeline, name).__doc__


def test_names_are_the_things_themselves():
    assert hybrid_mpc.pipeline.make_estimator is make_estimator
    assert hybrid_mpc.pipeline.run_job is run
    with pytest.raises(AttributeError, match="no_such_name"):
        hybrid_mpc.pipeline.no_such_name  # noqa: B018


def test_loops_are_made_where_torch_cannot_be_imported():
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "hybrid_mpc.pipeline.loops"
