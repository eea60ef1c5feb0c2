/* @map dc-energy@ */
/* Half the square: column 1 of the error map. */
static int32_t half_square(int32_t value, int shift)
{
    return (int32_t)rounded(product(value, value), shift);
}

/* @map dvoc@ */
/* p/V^2, saturated: columns 2 and 4 of the error map. A dead bus must not divide by zero. */
static int32_t over_square(int32_t p, int32_t V, int32_t least, int64_t first, int64_t most,
    int64_t second, int32_t high)
{
    const int32_t v = V < least ? least : V;
    int64_t quotient = p * first / v;
    quotient = quotient < -most ? -most : quotient > most ? most : quotient;
    return between(quotient * second / v, -high, high);
}

