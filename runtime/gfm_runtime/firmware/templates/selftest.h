/* Steps the laws of this folder through golden rows, and compares bits. @MADE@ */
#ifndef GFM_SELFTEST_H
#define GFM_SELFTEST_H

#include <stdint.h>

typedef @C_REAL@ golden_real;
typedef uint@BITS@_t golden_word;

enum { GOLDEN_LAWS = @LAWS@, GOLDEN_NX = @NX@, GOLDEN_NY = @NY@, GOLDEN_NU = @NU@ };
/* @if stages@ */
enum { GOLDEN_STAGE = @STAGE@, GOLDEN_E = @E_AT@, GOLDEN_BAD_U = @BAD_U@ };
/* @end@ */
/* @if counts@ */
enum { GOLDEN_COUNTS = @N_COUNTS@, GOLDEN_SENSED = @SENSED@, GOLDEN_OF_STEP = 4 };
/* @end@ */
enum { GOLDEN_WORDS = @WORDS@ };

/* One row: the number of words that differ. Rows go in their order; the first row starts anew.
 * row[0] says what comes before the step: 0 nothing, 1 init of the law row[1], 2 a change to it, 3 reset
 * and settle, 4 and 5 an error of memory: NaN in the state of the law, and of its stage; 6 and more a set of gains.
 * row[2] is what step returns; its inputs follow, then u and the state after the step. */
unsigned golden_row(const golden_word row[]);

/* With a row that a law steps through: what a step takes that refuses the last reference after all other
 * inputs have passed, and a step that refuses because that one did. The difference is what the checks
 * of the inputs take. Returns the law's BAD_REF. */
int golden_refusals(const golden_word row[], unsigned long elapsed[2]);

/* Names and sizes of the laws, and what GOLDEN_CLOCK counted during the last step. */
extern const char *const golden_names[GOLDEN_LAWS];
extern const unsigned golden_sizes[GOLDEN_LAWS];
extern unsigned long golden_elapsed;

#endif
