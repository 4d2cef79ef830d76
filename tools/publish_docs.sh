#!/usr/bin/env bash
# Put the pages that `make docs` built into the folder of their version of a site, and list its versions.
# DOCS_URL is the address of the site, DOCS_VERSION the name of the version: main or a tag.
set -euo pipefail
site=$1
rm -rf "${site:?}/$DOCS_VERSION"
cp -r docs/_build/html "$site/$DOCS_VERSION"
rm -rf "$site/$DOCS_VERSION/.doctrees" "$site/$DOCS_VERSION/.buildinfo"
cd "$site"
touch .nojekyll # GitHub Pages would leave out folders such as _static
versions=$(find . -maxdepth 1 -type d \( -name main -o -name 'v*' \) -printf '%f\n' | sort --version-sort --reverse)
newest=$(grep -m 1 '^v' <<<"$versions" || echo main)
jq --raw-input --null-input --arg url "$DOCS_URL" --arg newest "$newest" \
  '[inputs | {version: ., url: "\($url)/\(.)/"} + if . == $newest then {preferred: true} else {} end]' \
  <<<"$versions" >switcher.json
echo "<!doctype html><meta http-equiv=refresh content='0; url=$newest/'><a href='$newest/'>caryatid</a>" >index.html
