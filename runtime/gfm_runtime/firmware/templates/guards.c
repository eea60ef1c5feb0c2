#ifdef __FAST_MATH__
#error "-ffast-math changes the results: compile without it, and with -ffp-contract=off"
#endif
#if FLT_EVAL_METHOD != 0
#ifdef __s390__
#error "sums must be rounded to their own type: with GCC for s390x use -fexcess-precision=fast"
#else
#error "sums must be rounded to their own type: with GCC for i686 use -msse2 -mfpmath=sse"
#endif
#endif
#if FLT_RADIX != 2 || @DIG@ != @MANTISSA@
#error "@C_REAL@ is not the IEEE 754 type of @BITS@ bits"
#endif
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif
typedef char @P@_real_has_@BITS@_bits[sizeof(@P@_real) * CHAR_BIT == @BITS@ ? 1 : -1];
