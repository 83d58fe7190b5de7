import subprocess
import sys

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


def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(tmp_path):
    """numba alone looks at the file of the caller only, and would go on with the former callee."""
    files = {
        "__init__.py": "",
        "first/__init__.py": "",
        "first/_core.py": CALLEE.format(1),
        "second/__init__.py": "",
        "second/_core/__init__.py": "",
        "second/_core/kernels.py": CALLER,
    }
    for name, text in files.items():
        path = tmp_path / "toy" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def ask():
        command = [sys.executable, "-c", ASK]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert ask() == ["20", "0"]
    assert ask() == ["20", "1"]
    (tmp_path / "toy/first/_core.py").write_text(CALLEE.format(2))
    assert ask() == ["30", "0"]
    assert ask() == ["30", "1"]
