/* What the programs of gfmhil need of where they run: a start, a clock, and files of the host. A bare
 * processor in QEMU asks the host by semihosting; this machine has them itself. */
#ifndef GFM_BOARD_H
#define GFM_BOARD_H

enum { BOARD_READ = 1, BOARD_WRITE = 5 }; /* "rb" and "wb" */

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

/* A file's handle; `length` is that of its name. */
static inline long board_open(const char *name, long length, long mode)
{
    const long open[] = {(long)name, mode, length};
    return host(1, open);
}

/* How many bytes came: 0 at the end. */
static inline unsigned long board_read(long file, void *at, unsigned long size)
{
    const long read[] = {file, (long)at, (long)size};
    return size - (unsigned long)host(6, read);
}

static inline void board_write(long file, const void *at, unsigned long size)
{
    const long write[] = {file, (long)at, (long)size};
    host(5, write);
}

static inline void board_say(const char *text)
{
    host(4, text);
}

static inline void board_end(void)
{
    static const long done[] = {0x20026, 0};
    host(0x18, sizeof(long) == 4 ? (const void *)done[0] : done);
}
#else
#include <fcntl.h>
#include <stdio.h>
#include <unistd.h>

unsigned long clock_now(void)
{
    return 0;
}

#define ELAPSED(ticks) (ticks)

static inline long board_open(const char *name, long length, long mode)
{
    (void)length;
    return open(name, mode == BOARD_READ ? O_RDONLY : O_WRONLY);
}

static inline unsigned long board_read(long file, void *at, unsigned long size)
{
    const long got = read((int)file, at, size);
    return got > 0 ? (unsigned long)got : 0;
}

static inline void board_write(long file, const void *at, unsigned long size)
{
    if (write((int)file, at, size) != (long)size)
        _exit(1);
}

static inline void board_say(const char *text)
{
    fputs(text, stdout);
}

static inline void board_end(void)
{
}
#endif

#endif
