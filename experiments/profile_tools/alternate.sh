#!/bin/bash
# Run profile.py on two (or more) source trees in turn, and print medians per kernel side by side.
#     bash alternate.sh OLD_TREE NEW_TREE [MORE_TREES...] [-- options of profile.py]
# REPEATS (default 5), OUT (default /tmp/alternate), PYTHON (default python).
# A tree may be TREE@VARIANT=VALUE,...: the part behind @ becomes --set options, separated by commas.
here=$(cd "$(dirname "$0")" && pwd)
out=${OUT:-/tmp/alternate}
trees=()
while [ $# -gt 0 ] && [ "$1" != "--" ]; do trees+=("$1"); shift; done
[ "$1" = "--" ] && shift
mkdir -p "$out"
rm -f "$out"/*.json
for repeat in $(seq 1 "${REPEATS:-5}"); do
    for i in "${!trees[@]}"; do
        tree=${trees[$i]%%@*}
        sets=()
        if [[ "${trees[$i]}" == *@* ]]; then
            IFS=, read -ra parts <<< "${trees[$i]#*@}"
            for part in "${parts[@]}"; do sets+=(--set "$part"); done
        fi
        echo "== repeat $repeat, ${trees[$i]}"
        PYTHONPATH=$tree ${PYTHON:-python} "$here/profile.py" "$tree" "${sets[@]}" --label "${trees[$i]}" \
            --out "$out/$i.$repeat.json" "$@" > "$out/$i.$repeat.log" 2>&1 || tail -5 "$out/$i.$repeat.log"
        grep -E "^env step|^PPO|update alone|in all$" "$out/$i.$repeat.log"
    done
done
${PYTHON:-python} - "$out" "${trees[@]}" <<'PY'
import json, pathlib, statistics, sys
out, trees = pathlib.Path(sys.argv[1]), sys.argv[2:]
runs = [[json.loads(p.read_text()) for p in sorted(out.glob(f"{i}.*.json"))] for i in range(len(trees))]
def row(name, values, digits=2):
    cells = []
    for v in values:
        v = [x for x in v if x is not None]
        cells.append(f"{statistics.median(v):10.{digits}f} ({min(v):.{digits}f}-{max(v):.{digits}f})" if v else f"{'-':>10}")
    print(f"{name:28s}" + "".join(f"{c:>32s}" for c in cells))
for i, tree in enumerate(trees):
    print(f"[{i}] {tree}: {len(runs[i])} runs")
print("medians (range)")
for key in ("step_us", "beside_physics_us", "ended_fraction", "iteration_ms", "collect_ms", "update_ms", "batch_ms", "epochs_ms", "weights"):
    row(key, [[r.get(key) for r in each] for each in runs], 4 if key in ("ended_fraction", "weights") else 2)
for table in ("env", "collect", "batch", "epochs"):
    names = {}
    for each in runs:
        for r in each:
            for name, (total, _) in r.get(table, {}).items():
                names[name] = max(names.get(name, 0.0), total)
    if names:
        print(f"-- {table} [µs]")
    for name in sorted(names, key=names.get, reverse=True)[:40]:
        row(name[:28], [[r.get(table, {}).get(name, [0.0])[0] for r in each] for each in runs])
PY
