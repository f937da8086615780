#include <stdio.h>
$state
$start;
$correct;
int main(void)
{
    double row[$columns], back[$outputs + 1];
    ${name}_state state;
    FILE *readings = fopen("readings", "rb"), *forces = fopen("forces", "wb");
    if (readings == NULL || forces == NULL) return 1;
    while (fread(row, sizeof row, 1, readings) == 1) {
        $kind in[$inputs], out[$outputs] = {0};
        for (int i = 0; i < $inputs; ++i) in[i] = ($kind)row[i + 2];
        if (row[0] > 0.0) ${name}_start(&state);
        back[0] = ${name}_correct(&state, row[1], in, out);
        for (int k = 0; k < $outputs; ++k) back[k + 1] = (double)out[k];
        if (fwrite(back, sizeof back, 1, forces) != 1) return 1;
    }
    return fclose(forces) ? 1 : 0;
}
