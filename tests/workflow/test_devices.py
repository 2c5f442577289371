"""Where networks are trained: what is refused, and that the word changes nothing for those who leave it out."""

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.workflow.settings import check_device


def test_cpu_is_there():
    check_device("cpu")


@pytest.mark.parametrize("device", ["toaster", "cuda:77", "meta"])
def test_a_device_that_is_not_there_is_refused_by_name(device):
    with pytest.raises(InputError, match=rf"--device {device}: .*HM-WORKFLOW-036"):
        check_device(device)


@pytest.mark.parametrize("words", [("run", "golf_robot"), ("reproduce", "pendulum")])
def test_the_commands_refuse_it_before_they_make_a_folder(call, tmp_path, words):
    code, _, error = call(*words, "--device", "toaster", "--out", tmp_path / "out")
    assert code == 2
    assert "--device toaster" in error
    assert not (tmp_path / "out").exists()
