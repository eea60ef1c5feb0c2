#include "@P@.h"

/* @if fixed@ */
#include <stdbool.h>

/* C99 leaves it open how a negative number is shifted to the right: here its sign must stay. */
typedef char @P@_shifts_keep_the_sign[(-1 >> 1) == -1 ? 1 : -1];
/* @else@ */
#include <float.h>
#include <limits.h>
#include <math.h> /* fabs, which is no call, and sqrt */
#include <stdbool.h>

@GUARDS@
/* @end@ */

typedef @P@_real real;

/* What a tick works on beside the state. */
@TICK@
/* @if fixed@ */
static int64_t product(int32_t a, int32_t b)
{
    return (int64_t)a * b;
}

static int32_t between(int64_t value, int32_t low, int32_t high)
{
    return value < low ? low : value > high ? high : (int32_t)value;
}

/* To the nearest. */
static int64_t rounded(int64_t value, int shift)
{
    return (value + (INT64_C(1) << (shift - 1))) >> shift;
}

@ROOT@
/* @end@ */
@FUNCTIONS@
