/* Self-test of ${name}_compensate: compile with the file that holds it, and run.
   Exits with 0 where every value is met within $tolerance $unit. */
$library#include <stdio.h>

$declared

enum { COUNT = $count, AXES = $axes };

$arrays

int main(void)
{
    int failed = 0;
    for (int i = 0; i < COUNT; ++i) {
        $kind accel[AXES];
        ${name}_compensate($call, accel);
        for (int k = 0; k < AXES; ++k) {
            const $kind off = accel[k] - expected[i][k];
            if (!(off < $tolerance && -off < $tolerance)) {
                printf("vector %d, axis %d: off by %g $unit\n", i + 1, k + 1, (double)off);
                failed = 1;
            }
        }
$checked    }
    puts(failed ? "FAILED" : "${name}_compensate: all values met");
    return failed;
}
