#!/usr/bin/env bash
# Runs a command with the libraries kept to a narrow instruction set, as on an older processor.
#
#   scripts/narrow.sh avx2|narrowest COMMAND...
#
# The variables are read when a process starts: numpy's own loops, its and scipy's OpenBLAS, torch and its MKL and
# oneDNN. Open3D, small_gicp and libm choose by themselves; no variable reaches them.
set -euo pipefail
case "${1:-}" in
  avx2)
    export NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL AVX512_SPR" ATEN_CPU_CAPABILITY=avx2
    export OPENBLAS_CORETYPE=Haswell MKL_ENABLE_INSTRUCTIONS=AVX2 ONEDNN_MAX_CPU_ISA=AVX2
    ;;
  narrowest)
    export NPY_DISABLE_CPU_FEATURES="X86_V3 X86_V4 AVX512_ICL AVX512_SPR" ATEN_CPU_CAPABILITY=default
    export OPENBLAS_CORETYPE=Nehalem MKL_ENABLE_INSTRUCTIONS=SSE4_2 ONEDNN_MAX_CPU_ISA=SSE41
    ;;
  *)
    echo "usage: $0 avx2|narrowest COMMAND..." >&2
    exit 2
    ;;
esac
shift
exec "$@"
