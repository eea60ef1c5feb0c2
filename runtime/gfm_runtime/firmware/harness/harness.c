/* The program of gfmhil firmware check: steps the laws through golden.bin, and prints one line a law:
 * its number, rows, words that differ, fewest and most ticks of the clock in a step, bytes of an
 * instance. On a bare processor it asks the host for the file by semihosting. */
#include "selftest.h"

enum { AT_ONCE = 64, TIMED = 210 };

static golden_word rows[AT_ONCE][GOLDEN_WORDS];

#if defined(__arm__) || defined(__riscv)
int main(void);

#ifdef __arm__
extern char stack_top[];
void reset(void);
__attribute__((section(".vectors"), used)) void (*const vectors[])(void) = {
    (void (*)(void))stack_top, reset};

#define REGISTER(address) (*(volatile unsigned long *)(address))

void reset(void)
{
    REGISTER(0xE000ED88) |= 0xFUL << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    REGISTER(0xE000E014) = 0xFFFFFF; /* SysTick, at the processor's clock */
    REGISTER(0xE000E010) = 5;
    main();
    for (;;)
        ;
}

unsigned long clock_now(void)
{
    return 0xFFFFFF - REGISTER(0xE000E018);
}

#define ELAPSED(ticks) ((ticks) & 0xFFFFFF)

static long host(long operation, const void *arguments)
{
    register long r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = arguments;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}
#else
__asm__(".section .text.start,\"ax\"\n"
        ".global reset\n"
        "reset: la sp, stack_top\n"
        "li t0, 0x6000\n" /* the floating-point unit */
        "csrs mstatus, t0\n"
        "call main\n"
        "1: j 1b\n"
        ".text\n");

unsigned long clock_now(void)
{
    unsigned long now;
    __asm__ volatile("csrr %0, mcycle" : "=r"(now));
    return now;
}

#define ELAPSED(ticks) (ticks)

long host(long operation, const void *arguments);
__asm__(".section .text.host,\"ax\"\n"
        ".option push\n.option norvc\n.option norelax\n.balign 16\n"
        ".global host\n"
        "host: slli x0, x0, 0x1f\nebreak\nsrai x0, x0, 7\nret\n"
        ".option pop\n.text\n");
#endif

static unsigned long more(void)
{
    static const char name[] = "golden.bin";
    static long file;
    if (file == 0) {
        const long open[] = {(long)name, 1, sizeof name - 1};
        file = host(1, open);
    }
    const long read[] = {file, (long)rows, sizeof rows};
    return (unsigned long)((long)sizeof rows - host(6, read)) / sizeof rows[0];
}

static void say(const char *text)
{
    host(4, text);
}

static void finish(void)
{
    static const long done[] = {0x20026, 0};
    host(0x18, sizeof(long) == 4 ? (const void *)done[0] : done);
}
#else
#include <stdio.h>

unsigned long clock_now(void)
{
    return 0;
}

#define ELAPSED(ticks) (ticks)

static unsigned long more(void)
{
    static FILE *file;
    if (file == NULL)
        file = fopen("golden.bin", "rb");
    return file == NULL ? 0 : fread(rows, sizeof rows[0], AT_ONCE, file);
}

static void say(const char *text)
{
    fputs(text, stdout);
}

static void finish(void)
{
}
#endif

static void say_number(unsigned long value)
{
    char text[24];
    int at = 23;
    text[at] = 0;
    do {
        text[--at] = (char)('0' + value % 10);
        value /= 10;
    } while (value != 0);
    say(" ");
    say(text + at);
}

int main(void)
{
    static unsigned long counted[GOLDEN_LAWS], differ[GOLDEN_LAWS];
    static unsigned long least[GOLDEN_LAWS], most[GOLDEN_LAWS];
    unsigned long n, i, law, none = clock_now();
    none = ELAPSED(clock_now() - none);
    while ((n = more()) != 0) {
        for (i = 0; i < n; i++) {
            law = (unsigned long)rows[i][1];
            differ[law] += golden_row(rows[i]);
            counted[law]++;
            if (counted[law] <= TIMED && rows[i][2] == 0) {
                unsigned long ticks = ELAPSED(golden_elapsed) - none;
                if (least[law] == 0 || ticks < least[law])
                    least[law] = ticks;
                if (ticks > most[law])
                    most[law] = ticks;
            }
        }
    }
    for (law = 0; law < GOLDEN_LAWS; law++) {
        say("law");
        say_number(law);
        say_number(counted[law]);
        say_number(differ[law]);
        say_number(least[law]);
        say_number(most[law]);
        say_number(golden_sizes[law]);
        say("\n");
    }
    finish();
    return 0;
}
