/* The program of gfmhil firmware check: steps the laws through golden.bin, and prints one line a law:
 * its number, rows, words that differ, fewest and most ticks of the clock in a step, those of the
 * checks of its inputs, bytes of an instance. */
#include "board.h"
#include "selftest.h"

enum { AT_ONCE = 64, TIMED = 210 };

static golden_word rows[AT_ONCE][GOLDEN_WORDS];

static void say_number(unsigned long value)
{
    char text[24];
    int at = 23;
    text[at] = 0;
    do {
        text[--at] = (char)('0' + value % 10);
        value /= 10;
    } while (value != 0);
    board_say(" ");
    board_say(text + at);
}

int main(void)
{
    static const char name[] = "golden.bin";
    static unsigned long counted[GOLDEN_LAWS], differ[GOLDEN_LAWS];
    static unsigned long least[GOLDEN_LAWS], most[GOLDEN_LAWS], checks[GOLDEN_LAWS];
    const long file = board_open(name, sizeof name - 1, BOARD_READ);
    unsigned long n, i, law, none = clock_now();
    none = ELAPSED(clock_now() - none);
    while ((n = board_read(file, rows, sizeof rows) / sizeof rows[0]) != 0) {
        for (i = 0; i < n; i++) {
            law = (unsigned long)rows[i][1];
            differ[law] += golden_row(rows[i]);
            counted[law]++;
            if (counted[law] <= TIMED && rows[i][2] == 0) {
                unsigned long ticks = ELAPSED(golden_elapsed) - none;
                if (counted[law] == 1) {
                    unsigned long refused[2];
                    golden_refusals(rows[i], refused);
                    checks[law] = ELAPSED(refused[0]) - ELAPSED(refused[1]);
                }
                if (least[law] == 0 || ticks < least[law])
                    least[law] = ticks;
                if (ticks > most[law])
                    most[law] = ticks;
            }
        }
    }
    for (law = 0; law < GOLDEN_LAWS; law++) {
        board_say("law");
        say_number(law);
        say_number(counted[law]);
        say_number(differ[law]);
        say_number(least[law]);
        say_number(most[law]);
        say_number(checks[law]);
        say_number(golden_sizes[law]);
        board_say("\n");
    }
    board_end();
    return 0;
}
