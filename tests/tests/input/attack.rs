//! A short attack on every reader with damaged files; `scripts/check/attack.sh` makes long ones.

use std::process::Command;

#[test]
fn damaged_files_neither_crash_nor_hang_readers() {
    let findings = tempfile::tempdir().expect("a temporary folder");
    let attacker = env!("CARGO_BIN_EXE_clift-attack");
    let output = Command::new(attacker)
        .args(["--seconds", "1", "--seed", "1", "--findings"])
        .arg(findings.path())
        .output()
        .expect("the attacker starts");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}\n{}", String::from_utf8_lossy(&output.stderr));
    let listed = Command::new(attacker).arg("--list").output().expect("the attacker starts");
    assert_eq!(said.lines().count(), String::from_utf8_lossy(&listed.stdout).lines().count(), "{said}");
}
