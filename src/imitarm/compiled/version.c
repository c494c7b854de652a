/* The library knows from which sources it was built, so that a library of other sources is not used. */

#include <stdint.h>

int64_t imitarm_sources(void) { return IMITARM_SOURCES; }
