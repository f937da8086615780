/* Self-test of ${name}_compensate: compile with the file that holds it, and run.
   Exits with 0 where every value is met. */
#include <stdint.h>
#include <stdio.h>

$declaration;

enum { COUNT = $count, AXES = $axes };

$arrays

int main(void)
{
    int failed = 0;
    for (int i = 0; i < COUNT; ++i) {
        int32_t accel[AXES];
        ${name}_compensate(raw[i], accel);
        for (int k = 0; k < AXES; ++k)
            if (accel[k] != expected[i][k]) {
                printf("vector %d, axis %d: %ld\n", i + 1, k + 1, (long)accel[k]);
                failed = 1;
            }
    }
    puts(failed ? "FAILED" : "${name}_compensate: all values met");
    return failed;
}
