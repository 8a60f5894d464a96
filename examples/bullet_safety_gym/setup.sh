#!/bin/sh
# bullet-safety-gym in a virtual environment of its own (Python 3.11).
set -e
here=$(dirname "$0")
"${PYTHON:-python3.11}" -m venv "$here/.venv"
"$here/.venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$here/requirements.txt"
