"""Results of kernels do not depend on which of them a process has called before."""

import ast
import importlib.resources
import re
from pathlib import Path

PACKAGE = Path(str(importlib.resources.files("miricigale")))


def functions(path):
    """Yield the compiled functions of a module: name, text of the decorators, and names that are called."""
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            decorators = " ".join(map(ast.unparse, node.decorator_list))
            calls = {
                call.func.id
                for call in ast.walk(node)
                if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
            }
            if "njit" in decorators:
                yield node.name, decorators, calls


def test_fast_functions_that_kernels_share_are_copied_into_them():
    """Of code that is not, a process runs that of the kernel that was loaded first, rounded in its own way."""
    wrong = []
    for folder in PACKAGE.rglob("_core"):
        kernels = {path: list(functions(path)) for path in folder.rglob("*.py")}
        every_kernel = [kernel for part in kernels.values() for kernel in part]
        modules = [path for path in folder.parent.rglob("*.py") if "_core" not in path.parts]
        words = set(re.findall(r"\w+", " ".join(path.read_text("utf-8") for path in modules)))
        for path, part in kernels.items():
            for name, decorators, _ in part:
                is_fast = "fastmath" in decorators or "KERNEL" in decorators
                if not is_fast or "forceinline" in decorators or "PART" in decorators:
                    continue
                # private names are those of the module alone
                is_private = name.startswith("_")
                near = part if is_private else every_kernel
                callers = [caller for caller, _, calls in near if name in calls]
                from_python = not is_private and name in words
                if len(callers) > 1 or (callers and from_python):
                    wrong.append(f"{path.stem}.{name}: {', '.join(callers)}")
    assert wrong == []
