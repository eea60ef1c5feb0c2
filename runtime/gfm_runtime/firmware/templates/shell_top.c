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
/* @if fixed@ */
typedef struct {
    const int32_t *ref, *y;
/* @if mapped@ */
    int32_t r[5], m[5]; /* what the error map makes of ref and of y */
/* @end@ */
/* @if angle@ */
    int64_t a[2], b[2], turn[2]; /* directions of vectors */
/* @end@ */
    int64_t raw[3];    /* u before the limits, each row at its own exponent */
    int32_t excess[3]; /* what the limits add to it, for the anti-windup */
    int32_t u[3];
/* @if states@ */
    int32_t x_next[@N@];
/* @end@ */
} tick_t;

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

/* @if angle@ */
/* The integer below the square root of a number below 2^62. */
static int32_t root(int64_t square)
{
    int32_t below = 0;
    int bit;
    for (bit = 30; bit >= 0; bit--) {
        const int32_t next = below + (INT32_C(1) << bit);
        if (product(next, next) <= square) {
            below = next;
        }
    }
    return below;
}

/* @else@ */

/* @end@ */
/* @else@ */
@TICK@
/* @if own@ */
/* A step is compiled in one: calls and the way through memory cost more than the sums. */
#ifdef __GNUC__
#define IN_PLACE __attribute__((flatten))
#define APART __attribute__((noinline))
#else
#define IN_PLACE
#define APART
#endif

/* @end@ */
/* @end@ */
@FUNCTIONS@
