#!/usr/bin/env bash
# gwcs installs a top-level package "docs" beside its own.
#
# Seen with gwcs 1.0.3 and pytest 8.4.2: its wheel has docs/__init__.py and docs/conf.py, so that "import docs" works in
# any environment with gwcs (jwst and romancal bring it along). In a project whose documentation is in a folder docs
# without __init__.py, "pytest --pyargs docs", as test commands of packages of this field are written, then looks into
# the folder of gwcs, and no page of the project is tested. A good guess would be that a wheel installs the package of its name only.
# Nothing warns of it. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "gwcs==1.0.3" "pytest==8.4.2"
mkdir -p "$folder/project/docs"
printf 'def test_of_the_project():\n    pass\n' > "$folder/project/docs/test_page.py"
cd "$folder/project"
echo "tests in docs, by pytest docs:"
"$folder/venv/bin/python" -m pytest -q --collect-only -p no:cacheprovider docs | tee "$folder/by_path.txt"
echo "tests in docs, by pytest --pyargs docs:"
"$folder/venv/bin/python" -m pytest -q --collect-only -p no:cacheprovider --pyargs docs | tee "$folder/by_name.txt" || true
grep -q "test_of_the_project" "$folder/by_path.txt"
! grep -q "test_of_the_project" "$folder/by_name.txt"
"$folder/venv/bin/python" -P - <<'PYTHON'
from importlib.metadata import files

installed = sorted({str(path).split("/")[0] for path in files("gwcs") if str(path).endswith(".py")})
print("gwcs 1.0.3 installs", installed)
assert "docs" in installed, installed
PYTHON
