/* Morton's curve: an order in which what follows each other is near each other. */

/* Bits 0, 3, 6, ... of a number, up to 27, side by side: of a place on the curve its x. */
inline int gather_bits(uint x)
{
    x &= 0x09249249;
    x = (x | x >> 2) & 0x030C30C3;
    x = (x | x >> 4) & 0x0300F00F;
    x = (x | x >> 8) & 0x030000FF;
    return (x | x >> 16) & 0x3FF;
}
