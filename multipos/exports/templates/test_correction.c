/* Self-test of ${name}_correct: compile with the file that holds it, and run.
   Exits with 0 where every value is met within the rounding that its header states. */
#include <stdio.h>

$state
$start;
$correct;

enum { COUNT = $count, OUTPUTS = $outputs };

static const int begins[COUNT] = {$begins};
static const int codes[COUNT] = {$codes}; /* -1 where rounding decides */
static const double at[COUNT] = {$at};
$arrays
static const $kind tolerance[OUTPUTS] = {$tolerance};

int main(void)
{
    int failed = 0;
    ${name}_state state;
    for (int i = 0; i < COUNT; ++i) {
        $kind out[OUTPUTS];
        if (begins[i]) ${name}_start(&state);
        const int code = ${name}_correct(&state, at[i], in[i], out);
        if (codes[i] < 0) continue;
        if (code != codes[i]) {
            printf("row %d: not the code that was expected\n", i + 1);
            failed = 1;
        }
        for (int k = 0; k < OUTPUTS; ++k) {
            const $kind off = out[k] - expected[i][k];
            if (!(off <= tolerance[k] && -off <= tolerance[k])) {
                printf("row %d, output %d: off by %g\n", i + 1, k + 1, (double)off);
                failed = 1;
            }
        }
    }
    puts(failed ? "FAILED" : "${name}_correct: all values met");
    return failed;
}
