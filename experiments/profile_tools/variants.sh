#!/bin/bash
# Time variants of the update's kernels in one tree: bash variants.sh TREE
t=$1; n=jumper_warp.rl.fused.networks; u=jumper_warp.rl.fused.update
REPEATS=${REPEATS:-2} OUT=${OUT:-/tmp/variants} bash "$(dirname "$0")/alternate.sh" "$t" \
    "$t@$n.FORWARD_ROWS=128,$n.FORWARD_WARPS=8" "$t@$n.FORWARD_WARPS=8" \
    "$t@$n.BACKWARD_ROWS=128,$n.BACKWARD_WARPS=8" "$t@$n.BACKWARD_WARPS=8" \
    "$t@$n.GRADIENT_ROWS=32" "$t@$n.GRADIENT_ROWS=32,$n.GRADIENT_STAGES=4" "$t@$n.GRADIENT_STAGES=4" \
    "$t@$n.GRADIENT_TILE=64,$n.GRADIENT_WARPS=4" "$t@$n.MOST_SPLITS=16" "$t@$n.MOST_SPLITS=64,$n.LOSS_SPLITS=2" \
    "$t@$n.LOSS_SPLITS=2" "$t@$u.SUM_BLOCK=128" \
    -- --part ppo --iterations 20 "${@:2}"
