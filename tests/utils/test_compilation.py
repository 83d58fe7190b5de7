import subprocess
import sys

import pytest

from miricigale.utils.compilation import subpackage_of

CALLEE = """
from miricigale.utils.compilation import njit

@njit(cache=True)
def inner(x):
    return x + {0}
"""
CALLER = """
from miricigale.utils.compilation import njit
from toy.first._core import inner

@njit(cache=True)
def outer(x):
    return 10 * inner(x)
"""
ASK = """
from toy.second._core.kernels import outer
print(outer(1), sum(outer.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(tmp_path):
    """numba alone looks at the file of the caller only, and would go on with the former callee."""
    toy = tmp_path / "toy"
    for folder in ("first", "second/_core"):
        (toy / folder).mkdir(parents=True)
    for folder in ("", "first", "second", "second/_core"):
        (toy / folder / "__init__.py").touch()
    (toy / "first/_core.py").write_text(CALLEE.format(1))
    (toy / "second/_core/kernels.py").write_text(CALLER)

    def ask():
        command = [sys.executable, "-c", ASK]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert ask() == ["20", "0"]
    assert ask() == ["20", "1"]
    (toy / "first/_core.py").write_text(CALLEE.format(2))
    assert ask() == ["30", "0"]
    assert ask() == ["30", "1"]


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("miricigale.photometry._core.stamps", "photometry"),
        ("miricigale.psf._core", "psf"),
        ("numba.np.arraymath", ""),
        ("numba.cpython.listobj", ""),
        ("toy.first._core", ""),
        ("miricigale", ""),
    ],
)
def test_messages_name_subpackages_of_this_package_only(module, name):
    assert subpackage_of(module) == name
